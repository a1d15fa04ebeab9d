"""What a command prints: its report, and complaints on stderr."""

import os
import sys
import textwrap

COLUMNS = 120  # width of printed lines


class Report:
    """Prints values, with their details if `verbose`, and keeps these in `text`."""

    def __init__(self, verbose=False):
        self.text, self.verbose = "", verbose

    def say(self, value):
        """Print a value, with long lines wrapped."""
        details = getattr(value, "details", value)
        self.text += "\n" * bool(self.text) + _wrapped(details, "    ") + "\n"
        try:
            print(_wrapped(details if self.verbose else value, "    ") + "\n", flush=True)
        except BrokenPipeError:  # a reader that stops reading, such as head, does not stop the computation
            sys.stdout = open(os.devnull, "w")


def complain(*texts):
    """Print texts to stderr, with long lines wrapped."""
    for text in texts:
        print(_wrapped(text, "  "), file=sys.stderr)


def _wrapped(value, indent):
    wide = textwrap.TextWrapper(COLUMNS, subsequent_indent=indent, break_on_hyphens=False)
    return "\n".join(line if len(line) <= COLUMNS else wide.fill(line) for line in str(value).splitlines())
