"""Peak memory of whole commands on a short line; `flat_memory.py` holds it against the length of the line."""

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
