"""Tests the start of the command, with a small program in its place that prints its arguments."""

import concurrent.futures
import io
import json
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import textwrap
import threading
import time
import unittest
from contextlib import redirect_stderr
from pathlib import Path
from unittest import mock

sys.path.insert(0, str(Path(__file__).parents[1]))

import use3d  # noqa: E402

PROGRAM = """
    import json, signal, sys, time

    words = sys.argv[1:]
    if words[0] == "words":
        print(json.dumps(words))
    if words[0] == "export":
        open(words[words.index("--web") + 1], "w").write(json.dumps(words))
    if words[0] == "fails":
        for line in range(1000):
            print(f"line {line}", file=sys.stderr)
        sys.exit(3)
    if words[0] == "slow":
        heard = []
        def hear(*_):
            heard.append(1)
        signal.signal(signal.SIGINT, hear)
        print("step 1", file=sys.stderr, flush=True)
        while not heard:
            time.sleep(0.02)
        time.sleep(0.5)
        with open(words[1], "w") as file:
            file.write(f"{len(heard)}")
        sys.exit(130)
"""


class WithProgram(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)
        program = self.folder / "use3d"
        program.write_text(f"#!{sys.executable}\n{textwrap.dedent(PROGRAM)}")
        program.chmod(0o755)
        named = mock.patch.dict(os.environ, {"USE3D_PROGRAM": str(program)})
        named.start()
        self.addCleanup(named.stop)


@unittest.skipUnless(os.name == "posix", "a script stands in for the program")
class Command(WithProgram):
    def test_words_may_be_paths_and_numbers(self):
        said = use3d.run("words", Path("a"), 9, 2.5, "--json")
        self.assertEqual(said, ["words", "a", "9", "2.5", "--json"])
        self.assertEqual(json.loads(use3d.run("words", stderr=None)), ["words"])

    def test_options_of_a_shown_scene_may_be_flags(self):
        (self.folder / "scene.json").write_text('{"format": "3d-use scene"}')
        page = json.loads(use3d.Scene(self.folder)._page(dict(force=True, cameras="reef", views=None, metres_per_unit=2)))
        self.assertEqual(page[4:], ["--force", "--cameras", "reef", "--metres-per-unit", "2"])

    def test_a_failure_tells_the_last_lines_and_passes_all_of_them_on(self):
        passed = io.StringIO()
        with redirect_stderr(passed), self.assertRaises(use3d.CommandFailed) as caught:
            use3d.run("fails")
        self.assertEqual(caught.exception.code, 3)
        self.assertTrue(caught.exception.said.endswith("line 998\nline 999\n"))
        self.assertNotIn("line 10\n", caught.exception.said)
        self.assertEqual(len(passed.getvalue().splitlines()), 1000)

    def test_progress_is_passed_on_while_it_runs_and_an_interrupt_waits_for_the_checkpoint(self):
        passed, checkpoint = io.StringIO(), self.folder / "checkpoint"
        seen = []

        def interrupt():
            until = time.monotonic() + 20
            while "step 1" not in passed.getvalue() and time.monotonic() < until:
                time.sleep(0.02)
            seen.append(passed.getvalue())
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

        other = threading.Thread(target=interrupt)
        other.start()
        with redirect_stderr(passed), self.assertRaises(KeyboardInterrupt):
            use3d.run("slow", checkpoint)
        other.join()
        self.assertEqual(seen, ["step 1\n"])
        # Sends one signal: a second one would end the command at once.
        self.assertEqual(checkpoint.read_text(), "1")

    def test_a_command_whose_time_is_over_is_waited_for_too(self):
        checkpoint = self.folder / "checkpoint"
        with redirect_stderr(io.StringIO()), self.assertRaises(subprocess.TimeoutExpired):
            use3d.run("slow", checkpoint, timeout=1)
        self.assertEqual(checkpoint.read_text(), "1")


def _fails(_):
    use3d.run("fails")


@unittest.skipUnless(os.name == "posix", "a script stands in for the program")
class OtherProcesses(WithProgram):
    """A failure in any process is reported, and no process waits forever."""

    def check(self, raised):
        self.assertEqual(raised.exception.code, 3)
        self.assertIn("line 999", raised.exception.said)
        self.assertIn("exit code 3", str(raised.exception))

    def test_an_exception_is_the_same_after_pickling(self):
        with self.assertRaises(use3d.CommandFailed) as raised, redirect_stderr(io.StringIO()):
            use3d.run("fails")
        copy = pickle.loads(pickle.dumps(raised.exception))
        self.assertEqual((str(copy), copy.code, copy.said), (str(raised.exception), 3, raised.exception.said))

    def test_multiprocessing(self):
        with multiprocessing.get_context("spawn").Pool(1) as pool, self.assertRaises(use3d.CommandFailed) as raised:
            pool.map_async(_fails, [0]).get(60)
        self.check(raised)

    def test_concurrent_futures(self):
        with concurrent.futures.ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            with self.assertRaises(use3d.CommandFailed) as raised:
                pool.submit(_fails, 0).result(60)
        self.check(raised)

    def test_joblib(self):
        try:
            import joblib
        except ImportError:
            self.skipTest("joblib is not installed")
        with self.assertRaises(use3d.CommandFailed) as raised:
            joblib.Parallel(n_jobs=2, timeout=60)(joblib.delayed(_fails)(i) for i in range(2))
        self.check(raised)


if __name__ == "__main__":
    unittest.main()
