"""The main function of a script: parse its command line, train or evaluate, report errors in one line."""

from __future__ import annotations

import functools
import gc
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn, ParamSpec

from diffsim.training import distributed
from diffsim.training.errors import EXPECTED
from diffsim.training.evaluation import evaluate_checkpoint
from diffsim.training.flags import Args, parse

P = ParamSpec("P")


def script(
    flags: type[Args], train: Callable[[Args], None], evaluate: Callable[[Args], None] = evaluate_checkpoint
) -> Callable[..., None]:
    """Make a learner's main function: it parses a command line, by default the process's, and trains or evaluates."""

    def main(argv: Sequence[str] | None = None) -> None:
        args = parse(flags, argv)
        if args.evaluate:
            evaluate(args)
        else:
            train(args)

    main.__module__ = flags.__module__
    return command(main)


def command(main: Callable[P, None]) -> Callable[P, None]:
    """Make a script's main end the process with one line on stderr where its user is at fault.

    The exit code is 2 for an expected error and 130 for Ctrl-C. Other errors keep their traceback. Only the first rank
    prints. A reader of stdout that has read enough, as `head` does, ends the script silently.
    """

    @functools.wraps(main)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        report, threading.excepthook = threading.excepthook, _report_in_thread
        if main.__module__ == "__main__":
            gc.freeze()  # keep imported objects out of garbage collection
        try:
            main(*args, **kwargs)
        except BrokenPipeError:
            pass
        except KeyboardInterrupt:
            _end("interrupted", 130)
        except EXPECTED as error:
            _end(error, 2)
        except (RuntimeError, MemoryError) as error:
            if not isinstance(error, MemoryError) and "can't allocate memory" not in str(error):  # torch's on a CPU
                raise
            _end("not enough memory: choose smaller sizes", 2)
        finally:
            if main.__module__ == "__main__":
                signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process ends, and has nothing to stop
            threading.excepthook = report
            try:
                if sys.stdout is not None:  # closed from the start
                    sys.stdout.flush()
            except OSError:  # and no complaint when Python flushes once more at its end
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())

    return run


def _end(message: object, code: int) -> NoReturn:
    if distributed.rank() == 0:
        print(f"{Path(sys.argv[0]).name}: {str(message).partition(chr(10))[0]}", file=sys.stderr)
    raise SystemExit(code) from None


def _report_in_thread(args: threading.ExceptHookArgs) -> None:
    if type(args.thread).__name__ != "_AsyncWriterThread":  # tensorboard's raises its error in the main thread again
        threading.__excepthook__(args)
