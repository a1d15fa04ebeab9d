"""What a command prints: its report, and complaints on stderr."""

import os
import sys
import textwrap

COLUMNS = 120  # width of printed lines


class Report:
    """Prints values, and keeps what it printed in `text`."""

    def __init__(self):
        self.text = ""

    def say(self, value):
        """Print a value, with long lines wrapped."""
        text = "\n".join(_wrapped(line, "    ") for line in str(value).splitlines()) + "\n"
        self.text = f"{self.text}\n{text}" if self.text else text
        try:
            print(text, flush=True)
        except BrokenPipeError:  # a reader that stops reading, such as head, does not stop the computation
            sys.stdout = open(os.devnull, "w")


def complain(*texts):
    """Print texts to stderr, with long lines wrapped."""
    for text in texts:
        print(_wrapped(text, "  "), file=sys.stderr)


def _wrapped(line, indent):
    if len(line) <= COLUMNS:
        return line
    return textwrap.fill(line, COLUMNS, subsequent_indent=indent, break_on_hyphens=False)
