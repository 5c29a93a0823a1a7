# SPDX-License-Identifier: MIT
"""The one place that decides what a person sees when a command fails."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence

import typer

USAGE_EXIT = 2
INTERRUPTED_EXIT = 130

# What the library and the system raise for bad input and a refusing machine. Their subclasses that mean a bug do not
# count: they keep the traceback.
_EXPECTED = (ValueError, OSError, RuntimeError)
_BUGS = (NotImplementedError, RecursionError, UnicodeError)

# Typer carries its own copy of click in newer versions and depends on click in older ones: take its class from there.
_CLICK_ERROR: type[Exception] = typer.BadParameter.__mro__[2]

_traceback_wanted = False


def show_traceback(wanted: bool) -> None:
    """Whether expected errors, too, print where they came from."""
    global _traceback_wanted
    _traceback_wanted = wanted


def sentence(error: BaseException) -> str:
    """The message of an expected error on one line."""
    if isinstance(error, OSError) and error.strerror:
        where = f" '{os.fsdecode(error.filename)}'" if isinstance(error.filename, (str, bytes)) else ""
        text = f"cannot use{where or ' a file'}: {error.strerror}"
    elif isinstance(error, _CLICK_ERROR):
        text = error.format_message().rstrip(".")  # type: ignore[attr-defined]
        context = getattr(error, "ctx", None)
        if context is not None:
            text += f": see '{context.command_path} --help'"
    else:
        # LibTorch appends its C++ call stack to the message.
        text = str(error).split("\nException raised from")[0]
    return " ".join(text.split()) or type(error).__name__


def run(app: typer.Typer, argv: Sequence[str] | None) -> int:
    """Run ``app``; bad input becomes one sentence on stderr and exit code 2, all else keeps its traceback."""
    show_traceback(False)
    try:
        code = app(args=None if argv is None else list(argv), prog_name="ajna", standalone_mode=False)
        return code if isinstance(code, int) else 0
    except (KeyboardInterrupt, typer.Abort):
        return _fail("interrupted", INTERRUPTED_EXIT)
    except BrokenPipeError:
        # The reader (`head`) has left. Python would complain once more when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except _CLICK_ERROR as error:
        return _fail(sentence(error), USAGE_EXIT)
    except ImportError as error:
        if not (error.name or "").startswith("ajna"):
            raise
        return _fail(sentence(error), USAGE_EXIT)  # e.g. a build without vision
    except _BUGS:
        raise
    except _EXPECTED as error:
        return _fail(sentence(error), USAGE_EXIT)


def _fail(text: str, code: int) -> int:
    if _traceback_wanted:
        traceback.print_exc()
    print(f"ajna: {text}", file=sys.stderr)
    return code
