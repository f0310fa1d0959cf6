"""An object store on this machine, as much of S3's protocol as reading takes: lists, heads and ranges of objects."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, unquote, urlsplit
from xml.sax.saxutils import escape

_BUCKET = "maps"
_PAGE = 7
"""Keys that one answer lists: who reads has to ask again."""


@contextmanager
def object_store(folder: Path) -> Iterator[tuple[str, list[str]]]:
    """The URL of a place in a bucket, `{}` in it, whose objects are the files in a folder; and what was asked for so far."""
    asked: list[str] = []

    class Handler(_Objects):
        root, log = folder, asked

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        query = f"scheme=http&region=here&endpoint_override=127.0.0.1:{server.server_port}"
        try:
            yield f"s3://someone:secret@{_BUCKET}/{{}}?{query}", asked
        finally:
            server.shutdown()
            thread.join()


class _Objects(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    root: Path
    log: list[str]

    def do_HEAD(self) -> None:
        self._object(with_body=False)

    def do_GET(self) -> None:
        parts = urlsplit(self.path)
        query = {name: values[0] for name, values in parse_qs(parts.query).items()}
        if "list-type" in query:
            self._list(query)
        else:
            self._object(with_body=True)

    def log_message(self, format: str, *args: object) -> None:
        """Says nothing."""

    def _list(self, query: dict[str, str]) -> None:
        prefix, delimiter = query.get("prefix", ""), query.get("delimiter", "")
        self.log.append(f"LIST {prefix}")
        found: dict[str, str] = {}
        for key in self._keys():
            if not key.startswith(prefix):
                continue
            inner, is_folder, _ = (
                key[len(prefix) :].partition(delimiter) if delimiter else ("",) * 3
            )
            if is_folder:
                name = f"{prefix}{inner}{delimiter}"
                found[name] = f"<CommonPrefixes><Prefix>{escape(name)}</Prefix></CommonPrefixes>"
            else:
                size = (self.root / key).stat().st_size
                found[key] = (
                    f"<Contents><Key>{escape(key)}</Key><Size>{size}</Size>"
                    "<LastModified>2026-01-01T00:00:00.000Z</LastModified></Contents>"
                )
        names = [name for name in sorted(found) if name > query.get("continuation-token", "")]
        page = names[:_PAGE]
        more = len(names) > len(page)
        token = f"<NextContinuationToken>{escape(page[-1])}</NextContinuationToken>" if more else ""
        body = (
            '<?xml version="1.0" encoding="UTF-8"?><ListBucketResult>'
            f"<Name>{_BUCKET}</Name><Prefix>{escape(prefix)}</Prefix><KeyCount>{len(page)}</KeyCount>"
            f"<IsTruncated>{str(more).lower()}</IsTruncated>{token}"
            f"{''.join(found[name] for name in page)}</ListBucketResult>"
        )
        self._answer(200, body.encode(), "application/xml")

    def _keys(self) -> list[str]:
        files = (path for path in self.root.rglob("*") if path.is_file())
        return sorted(path.relative_to(self.root).as_posix() for path in files)

    def _object(self, *, with_body: bool) -> None:
        key = unquote(urlsplit(self.path).path).removeprefix(f"/{_BUCKET}").strip("/")
        self.log.append(f"{self.command} {key}")
        path = self.root / key
        if not key or not path.is_file():
            self._answer(404, b"", "application/xml")
            return
        content, status, extra = path.read_bytes(), 200, {}
        if asked := self.headers.get("Range"):
            first, _, last = asked.removeprefix("bytes=").partition("-")
            begin, end = int(first), min(int(last or len(content)) + 1, len(content))
            extra = {"Content-Range": f"bytes {begin}-{end - 1}/{len(content)}"}
            content, status = content[begin:end], 206
        self._answer(status, content, "binary/octet-stream", with_body=with_body, **extra)

    def _answer(
        self, status: int, body: bytes, kind: str, *, with_body: bool = True, **extra: str
    ) -> None:
        self.send_response(status)
        headers = {"Content-Type": kind, "Content-Length": str(len(body)), "ETag": '"0"', **extra}
        headers["Last-Modified"] = "Thu, 01 Jan 2026 00:00:00 GMT"
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        if with_body:
            self.wfile.write(body)
