"""Errors of reading and writing files: one line with the file, the rule or the reason, and the fix."""

from pathlib import Path


class BadFile(ValueError):
    """Error for a file that breaks a rule of its format; the message holds the file, the rule and the fix."""

    def __init__(self, path: Path, rule: str, fix: str = "") -> None:
        self.rule, self.fix = rule, fix
        super().__init__(one_line(f"{path}: {rule}" + (f" ({fix})" if fix else "")))


class WriteError(OSError):
    """Error for a file that could not be written; the message holds the file, the reason and the fix."""


def one_line(text: str) -> str:
    """A text with line breaks and other control characters, which file names may hold, as escape sequences."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
