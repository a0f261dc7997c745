"""The order of the pages. Its home is docs/index.md: a section for each heading, a page for each row."""

import re
from typing import Final

from website.pages import DOCS

INDEX: Final = DOCS / "index.md"
_ROW: Final = re.compile(r"^\| \[([^\]]+)\]\(([\w./-]+\.md)\) \|", re.MULTILINE)


def sections() -> dict[str, dict[str, str]]:
    """Return the pages that the index lists: by heading, the title and the file of each."""
    text = INDEX.read_text(encoding="utf-8")
    parts = re.split(r"^## (.*)$", text, flags=re.MULTILINE)
    found = zip(parts[1::2], parts[2::2], strict=True)
    return {name: dict(_ROW.findall(part)) for name, part in found if _ROW.search(part)}
