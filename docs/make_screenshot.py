"""A picture of the Rerun viewer, of a recording or of a live run, without a screen.

Needs Debian's mesa-vulkan-drivers and libvulkan1, or a graphics card.

    python docs/make_screenshot.py runs/.../run.rrd docs/viewer.png
    python docs/make_screenshot.py rerun+http://127.0.0.1:9876/proxy docs/viewer.png
"""

import time
from io import BytesIO
from pathlib import Path

import tyro
from PIL import Image
from viewers import START_S, native_viewer, steady_picture, wait_until


def main(
    source: str,
    target: Path,
    /,
    *,
    size: tuple[int, int] = (1600, 1000),
    at_step: int | None = None,
    live_s: float = 0.0,
) -> None:
    """Open the recording in a headless viewer, wait until the picture is steady, and keep it.

    Args:
        source: a .rrd file, or the address of a live run (rerun+http://...).
        target: the PNG.
        size: of the window, in pixels.
        at_step: the step to show; by default where the viewer opens it.
        live_s: for a live run, whose picture is never steady: seconds to watch before the picture is taken.
    """
    live = source.startswith("rerun+")
    if not live and not Path(source).is_file():
        raise SystemExit(f"{source} is neither a recording nor an address (rerun+http://...)")
    with native_viewer(connect_to=[source] if live else (), size=size) as client:
        if not live:
            client.open(str(Path(source).resolve()))
        time.sleep(1 + live_s)
        wait_until(lambda: not client.get_state().loading, START_S, "the viewer did not finish loading")
        if at_step is not None:
            client.set_time("step", sequence=at_step, play_state="paused")
        picture = client.take_screenshot() if live_s else steady_picture(client)
    target.parent.mkdir(parents=True, exist_ok=True)
    few = Image.open(BytesIO(picture)).convert("RGB").quantize(256, method=Image.Quantize.MEDIANCUT, dither=0)
    few.save(target, optimize=True)
    print(f"{target}: {target.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    tyro.cli(main)
