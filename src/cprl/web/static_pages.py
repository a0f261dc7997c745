"""Pages put together from the files of `static`: each is one file, which needs nothing from a network."""

import re
from base64 import b64encode
from hashlib import sha256
from importlib.resources import files


def page_of(template: str, *names: str, **parts: str) -> str:
    """Return the text of a page, with its style and its scripts in it.

    The page runs no other script, and asks no other server than the one that it comes from.

    Args:
        template: the name of an .html file of `static`. In it `$head` stands for head.html, and in both
            `$style`, `$script`, `$policy` and `$` before a name of `parts` for what is put there.
        names: names of .css and .js files of `static`. The style begins with `style.css`.
        parts: HTML, or JSON without "<", by the name in the template.
    """
    style = "".join(static_text(name) for name in ("style.css", *names) if name.endswith(".css"))
    script = "".join(static_text(name) for name in names if name.endswith(".js"))
    script_hash = b64encode(sha256(script.encode()).digest()).decode("ascii")
    policy = (
        "default-src 'none'; style-src 'unsafe-inline'; img-src data:; connect-src 'self'; "
        f"base-uri 'none'; form-action 'none'; script-src 'sha256-{script_hash}'"
    )
    inserted = {**parts, "style": style, "script": script, "policy": policy}
    pattern = rf"\$({'|'.join(inserted)})\b"
    text = static_text(template).replace("$head", static_text("head.html").rstrip())
    return re.sub(pattern, lambda name: inserted[name[1]], text)


def static_text(name: str) -> str:
    """Return the text of a file of `static`."""
    return files("cprl.web").joinpath("static", name).read_text(encoding="utf-8")
