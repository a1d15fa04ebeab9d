"""The command line: its parser. The module of a command is imported when it is the one that is given."""

import argparse
import os
import re
import sys
import warnings
from importlib import import_module

from servoctl.errors import ServoError, unknown
from servoctl.shell.printing import complain
from servoctl.version import __version__

COMMANDS = {  # name: module, its function that adds the arguments, help
    "list": ("listing", "add_list", "the gallery's scenes"),
    "report": ("report", "add_report", "the derivation of a model, its structure, its verdict; no simulation"),
    "run": ("run", "add_run", "derive, simulate, verify; write figures and numbers to a folder"),
    "tradeoff": ("tradeoff", "add_tradeoff", "measure errors and costs of methods and treatments of drift"),
    "export-c": ("export", "add_export", "the feedforward and residuals of a scene as one C file and header"),
    "cache": ("cache", "add_cache", "where compiled code and derivations are kept on disk, and how much"),
    "versions": ("versions", "add_versions", "versions, system and compiler, to paste into a report of a fault"),
}


def main(argv=None):
    """Run the command line.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the program's name; default: those of the process.

    Returns
    -------
    int
        0 done; 1 the motion stopped early, its verification failed, or files were written to another folder; 2 an
        error, explained on stderr; 3 the verification is inconclusive; 130 interrupted.
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    args, left = _parser(argv).parse_known_args(argv)
    if left:
        args.parser.error(f"unrecognized argument {left[0]!r}" + _option_like(left[0], args.parser.format_help()))
    args.command_line = argv
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # a run must not fail because a terminal has no Greek letters
    shown = warnings.formatwarning
    warnings.formatwarning = lambda message, *_: f"{message}\n"  # one line, without places in the sources
    try:
        return args.command(args)
    except ServoError as error:
        complain(f"{type(error).__name__}: {error}", *getattr(error, "__notes__", ()))
        return 2
    except BrokenPipeError:  # of a reader that stops reading, such as head
        sys.stdout = open(os.devnull, "w")
        return 0
    except KeyboardInterrupt:
        complain("Interrupted; files that were already written are kept.")
        return 130
    finally:
        warnings.formatwarning = shown


class _Parser(argparse.ArgumentParser):
    def error(self, message):
        """End with one line, where argparse prints all options before it."""
        self.exit(2, f"{self.prog}: {message}. See {self.prog} --help.\n")


def _option_like(given, text):
    """The option in a help's text that is nearest to a given one."""
    match = unknown(given.partition("=")[0], re.findall(r"(?<!\S)--[\w-]+", text), "option").details["match"]
    return f"; nearest: {match}" if match else ""


def _parser(argv):
    parser = _Parser(
        prog="servoctl",
        description="Inverse dynamics, simulation and control of machines under programs (servo constraints).",
        epilog="Examples: servoctl run overhead-crane;  servoctl run overhead-crane --set m_load=115;  "
        "servoctl report my_scene.py, a file that defines scene() -> (Mechanism, Program).",
    )
    parser.add_argument(
        "--version", action="version", version=f"servoctl {__version__}", help="print the version and exit"
    )
    commands = parser.add_subparsers(required=True, metavar="command")
    given = next((text for text in argv if not text.startswith("-")), None)
    if given not in (None, *COMMANDS):
        parser.error(str(unknown(given, COMMANDS, "command")).rstrip("."))
    for name, (module, add, about) in COMMANDS.items():
        command = commands.add_parser(name, help=about)
        command.set_defaults(parser=command)
        if name == given:
            getattr(import_module(f"servoctl.shell.{module}"), add)(command)
    return parser
