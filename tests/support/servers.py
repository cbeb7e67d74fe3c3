"""Servers of files in this process: S3 as moto mocks it, and a web server that may answer ranges."""

import contextlib
import http.server
import logging
import os
import re
import threading
import uuid
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import fsspec
import pytest


@contextlib.contextmanager
def s3_bucket() -> Iterator[str]:
    # Yield the URL of a new bucket; the environment has its server and keys
    server = pytest.importorskip("moto.server", reason="moto is not installed: no bucket to read from")
    pytest.importorskip("s3fs", reason="s3fs is not installed: fsspec reads no S3")
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    served = server.ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    served.start()
    host, port = served.get_host_and_port()
    variables = {"AWS_ACCESS_KEY_ID": "mock", "AWS_SECRET_ACCESS_KEY": "mock", "AWS_REGION": "us-east-1"}
    with mock.patch.dict(os.environ, {**variables, "AWS_ENDPOINT_URL": f"http://{host}:{port}"}):
        name = f"flights-{uuid.uuid4().hex}"  # all servers of a process share their buckets
        fsspec.filesystem("s3", skip_instance_cache=True).mkdir(name)
        yield f"s3://{name}"
    served.stop()
    fsspec.get_filesystem_class("s3").clear_instance_cache()


class _Handler(http.server.SimpleHTTPRequestHandler):
    # Answers ranges of bytes, and lists no folder.
    has_ranges, asked = True, list[str]()

    def log_message(self, *_: Any) -> None:
        pass

    def list_directory(self, path: Any) -> None:  # noqa: ARG002
        self.send_error(403)

    def send_head(self) -> Any:
        asked = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        path = Path(self.translate_path(self.path))
        if not (self.has_ranges and asked and path.is_file()):
            return super().send_head()
        first, last, size = int(asked[1]), min(int(asked[2]), path.stat().st_size - 1), path.stat().st_size
        self.send_response(206)
        self.send_header("Content-Range", f"bytes {first}-{last}/{size}")
        self.send_header("Content-Length", str(last - first + 1))
        self.end_headers()
        self.wfile.write(path.read_bytes()[first : last + 1])
        return None


@contextlib.contextmanager
def web_server(folder: Path, *, ranges: bool = True) -> Iterator[str]:
    # Yield the address of a server of a folder
    pytest.importorskip("aiohttp", reason="aiohttp is not installed: fsspec reads no http")
    handler = type("Handler", (_Handler,), {"has_ranges": ranges})
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(handler, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()
