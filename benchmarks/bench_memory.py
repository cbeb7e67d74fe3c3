"""Memory and growth of whole commands; `flat_memory.py` and `growth.py` measure them at full size."""

import tempfile
from pathlib import Path


class WholeCommand:
    """As users call it, in the process of the benchmark. Maps and renders have cases beside their times."""

    params = (["signatures", "report", "survey"], [96])
    param_names = ("command", "lines")
    timeout = 300

    def setup(self, command, lines):
        from benchmarks.flat_memory import write_line

        self.folder = tempfile.TemporaryDirectory(prefix="hyperpaint-bench-")
        write_line(Path(self.folder.name), lines, command)

    def peakmem_of_the_process(self, command, *_):
        from benchmarks.flat_memory import run_here

        run_here(command, Path(self.folder.name), None)

    def teardown(self, *_):
        self.folder.cleanup()


class Growth:
    """CPU time at 4n over that at n, in processes of their own: 4 at most where it is linear."""

    params = (["process", "info"], ["flight lines", "groups"])
    param_names = ("command", "grows")
    timeout = 600

    def setup(self, command, grows):
        if (command == "info") != (grows == "groups"):
            raise NotImplementedError  # asv's way to leave a combination out

    def track_growth(self, command, grows):
        from benchmarks.common import SMOKE
        from benchmarks.growth import measured

        first, _, last = measured(command, grows, 8 if SMOKE else 1)
        return last["cpu"] / first["cpu"]
