"""What a command that cannot go on says: a sentence, and no traceback."""

from .driver import Ended


def assert_refused(ended: Ended, *words: str) -> None:
    """It ended with exit code 1 and one sentence on standard error, which has these words; a second line may
    say how the run is resumed."""
    assert ended.code == 1, ended.said
    lines = ended.err.strip().splitlines()
    assert lines, f"nothing was said, but on standard output: {ended.out}"
    assert "Traceback" not in ended.err, ended.err
    assert lines[0].startswith("cprl: "), ended.err
    assert all(line.startswith("To resume: ") for line in lines[1:]), ended.err
    for word in words:
        assert word in lines[0], ended.err
