"""Datasets in any file system that pyarrow or fsspec opens by URL: what is read of them is copied here first."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from itertools import chain
from pathlib import Path, PurePosixPath
from urllib.parse import unquote, urlsplit

from pyarrow.fs import FileInfo, FileSelector, FileSystem, FileType, FSSpecHandler, PyFileSystem

from crowdmap_torch.io.budget import budget_now
from crowdmap_torch.io.errors import InputError, calling, needing, one_line

_URL = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]*://")
_OF_ARROW = ("abfs", "abfss", "gcs", "gs", "hdfs", "s3", "viewfs")
"""Schemes that pyarrow opens by itself."""
_TABLE, _TEXT = ".parquet", ".json"
"""Files that readers open outside of rigs: pictures may lie beside them. In a rig's folder files have any name."""
_AT_ONCE = 16
"""Files under way at a time: of small ones most of the time is the way there and back."""
_PIECE = 1 << 20


@dataclass(frozen=True)
class Url:
    """A dataset's folder elsewhere, by a URL that may hold keys: these are never shown."""

    text: str = field(repr=False)

    def __str__(self) -> str:
        parts = urlsplit(self.text)
        place = f"{parts.netloc.rpartition('@')[2]}{parts.path}".rstrip("/")
        return f"{parts.scheme}://{place}"

    @property
    def name(self) -> str:
        """The last part of it."""
        return PurePosixPath(urlsplit(self.text).path).name or "dataset"


Place = Path | Url
"""Where a dataset is."""


def place_of(text: str | Path) -> Place:
    """A path, or the URL that a text is; `file://` is a path."""
    if isinstance(text, Path) or not _URL.match(text):
        return Path(text)
    parts = urlsplit(text)
    return Path(unquote(parts.path)) if parts.scheme == "file" else Url(text)


@contextmanager
def at_hand(
    place: Place, journeys: Sequence[str] | None = None, *, survey: bool = True
) -> Iterator[Path]:
    """A dataset's folder here: its own, or, as long as inside, a copy of one elsewhere.

    Of that there are the `journeys` alone that are named, or that patterns match, as in `load_dataset`, of others empty
    folders; and, if wanted, the `survey`. What readers refuse for its size is not copied: an empty file of that size is in
    its place. InputErrors name the URL, not the copy. InputError if it cannot be read.
    """
    if isinstance(place, Path):
        yield place
        return
    with tempfile.TemporaryDirectory(prefix="crowdmap-") as beside:
        folder = Path(beside) / place.name
        _copy(place, folder, journeys, survey)
        with calling(folder, str(place)):
            yield folder


def _copy(url: Url, folder: Path, journeys: Sequence[str] | None, survey: bool) -> None:
    source = _Source.of(url)
    top = source.inside("")
    if not top:
        raise InputError(
            f"{url}: the dataset's folder is missing; expected dataset.json in it", "missing-file"
        )
    folder.mkdir()
    drives = {one.base_name: one for one in source.inside("journeys") if _is_journey(one)}
    for info in drives.values():
        # Of those that are not wanted the names are told where one is asked for that is not there.
        source.place(info, folder).mkdir(parents=True)
    names = list(drives)
    if journeys is not None:
        names = [name for one in journeys for name in matching(names, one)]
    budget = budget_now()

    def fetch(info: FileInfo) -> None:
        is_table = PurePosixPath(info.path).suffix == _TABLE
        source.fetch(info, folder, budget.table_bytes if is_table else budget.text_bytes)

    with ThreadPoolExecutor(_AT_ONCE) as pool:
        of_drives = pool.map(source.inside, [f"journeys/{name}" for name in dict.fromkeys(names)])
        found = [*top, *chain.from_iterable(of_drives)]
        found += source.inside("survey", recursive=True) if survey else []
        files = [one for one in found if PurePosixPath(one.path).suffix in (_TABLE, _TEXT)]
        files += source.inside("rigs", recursive=True)
        for _ in pool.map(fetch, [one for one in files if one.type == FileType.File]):
            pass


def _is_journey(info: FileInfo) -> bool:
    return info.type == FileType.Directory and not info.base_name.startswith(".")


def matching(names: Sequence[str], asked: str) -> list[str]:
    """Those of some names that are `asked` for, or else that match it as a pattern: an id may hold what would be one."""
    own = [name for name in names if name == asked]
    return own or [name for name in names if fnmatchcase(name, asked)]


@dataclass(frozen=True)
class _Source:
    """A folder of a file system."""

    url: Url
    system: FileSystem
    root: str

    @classmethod
    def of(cls, url: Url) -> _Source:
        """InputError if no file system is known by the URL's scheme, or it is not one that can be opened."""
        scheme = urlsplit(url.text).scheme.lower()
        try:
            if scheme in _OF_ARROW:
                return cls(url, *FileSystem.from_uri(url.text))
            with needing(f"{scheme}://", "fsspec"):
                import fsspec.core
            system, root = fsspec.core.url_to_fs(url.text)
            return cls(url, PyFileSystem(FSSpecHandler(system)), root)
        except InputError:
            raise
        except (OSError, ValueError, ImportError, NotImplementedError) as error:
            raise InputError(
                f"{url}: no file system that pyarrow or fsspec opens ({_told(url, error)}); expected a folder or a URL "
                "such as s3://BUCKET/DATASET"
            ) from None

    def inside(self, part: str, *, recursive: bool = False) -> list[FileInfo]:
        """What a folder in it holds; nothing if it is not there."""
        at = f"{self.root.rstrip('/')}/{part}".rstrip("/")
        with self._reached(part):
            selector = FileSelector(at, allow_not_found=True, recursive=recursive)
            return self.system.get_file_info(selector)

    def place(self, info: FileInfo, folder: Path) -> Path:
        """Where in the copy something of it goes."""
        inner = PurePosixPath(info.path.strip("/")).relative_to(self.root.strip("/"))
        if ".." in inner.parts:
            raise InputError(f"{self.url}/{inner}: a name that leads out of the dataset")
        return folder / inner

    def fetch(self, info: FileInfo, folder: Path, most: int) -> None:
        """Copies a file of at most so many bytes."""
        path = self.place(info, folder)
        with self._reached(path.relative_to(folder).as_posix()):
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("wb") as copy:
                if info.size is not None and info.size > most:
                    copy.truncate(info.size)
                    return
                with self.system.open_input_stream(info.path, compression=None) as stream:
                    # One byte more than may be read is refused as all of it would be.
                    left = most + 1
                    while left > 0 and (piece := stream.read(min(_PIECE, left))):
                        left -= copy.write(piece)

    @contextmanager
    def _reached(self, part: str) -> Iterator[None]:
        try:
            yield
        except (OSError, ValueError, NotImplementedError) as error:
            named = f"{self.url}/{part}".rstrip("/")
            raise InputError(
                f"{named}: cannot be read ({_told(self.url, error)})", "unreadable"
            ) from None


def _told(url: Url, error: Exception) -> str:
    """What somebody else's error says, without what the URL hides."""
    text = one_line(error).replace(url.text, str(url))
    hidden = urlsplit(url.text)
    for secret in (hidden.netloc.rpartition("@")[0], hidden.password, hidden.query):
        if secret:
            text = text.replace(secret, "...")
    return text
