"""Flights in a bucket, processed on clusters: time, bytes, bits, and killed programs.

``python benchmarks/bucket.py --lines 200 --workers 1 2 4 --kills 20 --clients 5`` starts an S3 server
(moto) in a process of its own, puts a simulated collect of many short flight lines into it, and processes it
from there into the same bucket. All connections pass a relay that counts their bytes. It prints a row for
every cluster: seconds, bytes read and written over the least possible (inputs once; the objects of the store
once), and whether the arrays equal those of a run on local files. Then workers, and at last the
whole program, are killed at random moments; the run that follows must give the same arrays, and `verify` must
find them whole.
"""

import argparse
import asyncio
import logging
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import fsspec

import hyperpaint as hp
from hyperpaint.io.store import Location, Manifest


class Relay:
    """Passes connections on to a server, and counts their bytes."""

    def __init__(self, port: int) -> None:
        self.sent = self.received = 0
        self._target = port
        self._loop = asyncio.new_event_loop()
        started = threading.Event()
        threading.Thread(target=self._run, args=(started,), daemon=True).start()
        started.wait()

    def _run(self, started: threading.Event) -> None:
        asyncio.set_event_loop(self._loop)
        server = self._loop.run_until_complete(asyncio.start_server(self._connect, "127.0.0.1", 0))
        self.port = server.sockets[0].getsockname()[1]
        started.set()
        self._loop.run_forever()

    async def _connect(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        answers, requests = await asyncio.open_connection("127.0.0.1", self._target)

        async def pass_on(source: asyncio.StreamReader, target: asyncio.StreamWriter, name: str) -> None:
            try:
                while data := await source.read(1 << 16):
                    setattr(self, name, getattr(self, name) + len(data))
                    target.write(data)
                    await target.drain()
            except ConnectionError:
                pass
            finally:
                target.close()

        await asyncio.gather(pass_on(reader, requests, "sent"), pass_on(answers, writer, "received"))


@contextmanager
def bucket_server() -> Iterator[tuple[str, Relay]]:
    """Yield the URL of a bucket, and the relay before its server; the environment has keys and address."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        for _ in range(200):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.1)
        relay = Relay(port)
        os.environ |= {
            "AWS_ACCESS_KEY_ID": "bench", "AWS_SECRET_ACCESS_KEY": "bench", "AWS_REGION": "us-east-1",
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{relay.port}",
        }  # fmt: skip
        fsspec.filesystem("s3").mkdir("flights")
        yield "s3://flights", relay
    finally:
        server.kill()


def differences(store: str, local: Path) -> list[str]:
    """Return the arrays of a store whose chunks have other checksums than those of a local one.

    Names and checksums of all chunks are in the manifests; `verify` compares the chunks with them.
    """
    arrays = []
    for path in (store, local):
        manifest = Manifest.read(Location.of(path))
        groups = {} if manifest is None else manifest.groups
        rows = (
            (f"{group}/{name}", array) for group in groups for name, array in groups[group].arrays.items()
        )
        arrays.append({name: array.digest for name, array in rows})
    return sorted(name for name in arrays[0] | arrays[1] if arrays[0].get(name) != arrays[1].get(name))


def stored_bytes(url: str) -> int:
    """Return the bytes of all objects below a URL."""
    rows = fsspec.filesystem("s3", use_listings_cache=False).find(url, detail=True)
    return sum(int(row["size"]) for row in rows.values())


def cluster(workers: int) -> Any:
    """Return a cluster of workers of one thread, whose tasks survive many deaths."""
    import dask
    from distributed import LocalCluster

    dask.config.set({"distributed.scheduler.allowed-failures": 50})
    return LocalCluster(
        n_workers=workers, threads_per_worker=1, dashboard_address=":0", silence_logs=logging.CRITICAL
    )


def process(collect: str, store: str, address: str) -> subprocess.Popen[bytes]:
    """Start a run of the command line."""
    words = ["process", collect, "--out", store, "--scheduler", address, "--quiet"]
    return subprocess.Popen([sys.executable, "-m", "hyperpaint", *words], stdout=subprocess.DEVNULL)


def main() -> None:
    """Print the table, then how killed runs ended."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--lines", type=int, default=200, help="number of flight lines")
    parser.add_argument("--scan-lines", type=int, default=200)
    parser.add_argument("--bands", type=int, default=24)
    parser.add_argument("--columns", type=int, default=32)
    parser.add_argument("--workers", type=int, nargs="*", default=[1, 2, 4])
    parser.add_argument("--kills", type=int, default=0, help="workers to kill")
    parser.add_argument("--clients", type=int, default=0, help="programs to kill")
    parser.add_argument("--seed", type=int, default=36)
    options = parser.parse_args()
    rng = random.Random(options.seed)
    with tempfile.TemporaryDirectory() as scratch, bucket_server() as (url, relay):
        print(f"{options.lines} flight lines of {options.scan_lines} x {options.bands} x {options.columns}")
        flight = Path(scratch, "flight")
        collect = hp.simulate_collect(
            flight, scene="plan", lines=options.lines * options.scan_lines, bands=options.bands,
            columns=options.columns, cubes=options.lines,
        )  # fmt: skip
        begin = time.perf_counter()
        local = hp.process(collect, Path(scratch, "lot.zarr"))
        print(f"local files, threads of this machine: {time.perf_counter() - begin:.1f} s")
        fsspec.filesystem("s3").put(str(flight), f"{url}/flight", recursive=True)
        files = [path for path in flight.rglob("*") if path.is_file() and "truth.zarr" not in path.parts]
        inputs = sum(path.stat().st_size for path in files)
        there = f"{url}/flight/collect.toml"
        for workers in options.workers:
            store = f"{url}/lot_{workers}.zarr"
            with cluster(workers) as running:
                before, begin = (relay.received, relay.sent), time.perf_counter()
                assert process(there, store, running.scheduler_address).wait() == 0
                seconds = time.perf_counter() - begin
            read, written = relay.received - before[0], relay.sent - before[1]
            size = stored_bytes(store)
            print(
                f"{workers} workers: {seconds:.1f} s, read {read / 1e6:.1f} MB "
                f"({read / inputs:.2f} of the inputs), written {written / 1e6:.1f} MB "
                f"({written / size:.2f} of the store), differences: {differences(store, local) or 'none'}",
                flush=True,
            )
        for kind, number in (("worker", options.kills), ("client", options.clients)):
            if not number:
                continue
            store, killed, runs = f"{url}/killed_{kind}.zarr", 0, 0
            with cluster(2) as running:
                while True:
                    runs += 1
                    client = process(there, store, running.scheduler_address)
                    while client.poll() is None and killed < number:
                        time.sleep(rng.uniform(2.0, 6.0) if kind == "worker" else rng.uniform(5.0, 40.0))
                        # a nanny gives up a worker that dies while it starts, and the cluster one that is
                        # not back in seconds: both are started again
                        running.scale(2)
                        pids = [worker.pid for worker in running.scheduler.workers.values()]
                        pid = client.pid if kind == "client" else rng.choice(pids or [0])
                        if pid and client.poll() is None:
                            os.kill(pid, signal.SIGKILL)
                            killed += 1
                            if kind == "client":
                                break
                    client.wait()
                    if runs > 3 * number or (client.returncode == 0 and killed == number):
                        break
                    if client.returncode == 0:  # done before the last was killed: begin again
                        fsspec.filesystem("s3").rm(store, recursive=True)
            report = hp.verify(store)
            print(
                f"{killed} {kind}s killed in {runs} runs; {report}; "
                f"differences: {differences(store, local) or 'none'}",
                flush=True,
            )


if __name__ == "__main__":
    main()
