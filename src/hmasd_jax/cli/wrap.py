"""Lines that fit into the terminal."""

import re
import shutil
import textwrap


def fill(text: str, indent: int = 2) -> str:
    """Break a text where the terminal ends, and indent all lines but the first."""
    return textwrap.fill(
        text,
        shutil.get_terminal_size().columns,
        subsequent_indent=" " * indent,
        break_long_words=False,
        break_on_hyphens=False,
    )


def unbreak(text: str) -> str:
    """Remove the line breaks within the paragraphs of a text."""
    return "\n\n".join(" ".join(part.split()) for part in re.split(r"\n\s*\n", text.strip()))
