"""The files of figures: which suffixes they may have, their metadata and the colours of a PNG."""

from io import BytesIO
from pathlib import Path
from typing import Final

from matplotlib.figure import Figure

from cprl.runs.files import refuse_to_write_over, write_atomically
from cprl.values import refusal

PICTURE_SUFFIXES: Final = (".png", ".pdf", ".svg")
PNG_COLOURS: Final = 128
"""The number of colours in a PNG of lines. With all colours it looks the same and is three times larger."""
PNG_SHADES: Final = 256
"""The number of colours in a PNG that shows a colour scale."""
FIGURE_STYLE: Final = "cprl figures 2"
"""The name of the style in the metadata of every figure. Raise its number when figures change their look."""


def check_picture(path: str | Path, name: str = "path", *, refuse_existing: bool = False) -> Path:
    """Check the path of a figure before hours of work, and return it; its folder need not exist.

    Args:
        name: the name of the argument, for a refusal.
        refuse_existing: whether to refuse a path that exists.

    Raises:
        ValueError: for another suffix than `PICTURE_SUFFIXES`.
        FileExistsError: if the path exists and `refuse_existing`.
    """
    path = Path(path)
    if path.suffix not in PICTURE_SUFFIXES:
        raise refusal(name, str(path), f"a file whose name ends in {', '.join(PICTURE_SUFFIXES)}")
    if refuse_existing:
        refuse_to_write_over(path)
    return path


def save(
    figure: Figure, path: Path, *, colours: int = PNG_COLOURS, title: str = "", caption: str = ""
) -> Path:
    """Write a figure completely or not at all.

    Args:
        colours: the number of colours in a PNG.
        title: the title in the file's metadata.
        caption: the description in the file's metadata.
    """
    drawn = BytesIO()
    metadata: dict[str, str | None] = {"Title": title, "Description": caption, "Software": FIGURE_STYLE}
    if path.suffix == ".pdf":
        metadata = {"Title": title, "Subject": caption, "Creator": FIGURE_STYLE, "CreationDate": None}
    elif path.suffix == ".svg":
        metadata = {"Title": title, "Description": caption, "Creator": FIGURE_STYLE, "Date": None}
    figure.savefig(drawn, format=path.suffix[1:], metadata=metadata)
    drawn = _with_colours(drawn, colours) if path.suffix == ".png" else drawn
    return write_atomically(path, lambda file: file.write(drawn.getvalue()))


def _with_colours(drawn: BytesIO, colours: int) -> BytesIO:
    """Return a PNG with fewer colours, each near those that it replaces."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    reduced = BytesIO()
    texts = PngInfo()
    with Image.open(drawn) as picture:
        for name in ("Title", "Description", "Software"):
            texts.add_itxt(name, picture.info[name])
        quantized = picture.convert("RGB").quantize(
            colours, method=Image.Quantize.MAXCOVERAGE, kmeans=2, dither=Image.Dither.NONE
        )
        quantized.save(reduced, format="png", optimize=True, dpi=picture.info["dpi"], pnginfo=texts)
    return reduced
