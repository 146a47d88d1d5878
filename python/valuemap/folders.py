"""Writing whole folders and files: beside first, then renamed, so that nothing is ever half-written or lost.

Only what valuemap wrote is ever replaced or removed. Each folder that something was written to has a ledger, the hidden
file `.valuemap-files`: one line a file with its SHA-256, as `sha256sum` writes and checks them. A file is ours if it is
listed there and was not changed since. All others stay, and where one would have to give way, nothing is written.
"""

from __future__ import annotations

import functools
import hashlib
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from pathlib import Path

from valuemap.errors import OutputError
from valuemap.system import OWN_FILE, folder_lock, sync_file

LEDGER = ".valuemap-files"
"""In each folder: which files valuemap wrote there, and their SHA-256."""

_STAGING = ".valuemap-new-"
_FRESH, _DECIDED, _STALE = "fresh", "decided", "stale"
_NAME_LENGTH = 100


@contextmanager
def new_folder(
    path: Path, *, parts: Collection[str], part_folders: Collection[str] = (), force: bool = False
) -> Iterator[Path]:
    """Yield an empty folder whose files take their places in `path` together when the block ends well.

    An older set of files there that valuemap wrote is replaced; whatever else is in the folder stays. Where a crash
    comes between, `settle` or the next writer goes on with what was decided, so that the folder is either as before or
    all new. On any exception, Ctrl-C included, `path` is as before.

    Parameters
    ----------
    path
        A link to a folder is followed.
    parts
        Names of all files that such a folder may have: those that are not written anew must not stay of an older set.
    part_folders
        Names of folders in it that belong to an older set: what valuemap wrote into them is removed.
    force
        Replace files of these names that are not ours, too.

    Raises
    ------
    OutputError
        `path` is a file or a link to nothing, a file of somebody else is in the way, or the place cannot be written.
    """
    workspace = None
    try:
        path = _followed(path)
        if path.exists():
            settle(path)
            _refuse_other_kind(path, parts)
            check_files(path, parts, force=force)
        workspace = _workspace_for(path)
        with _locked(workspace, is_new=True):
            fresh = workspace / _FRESH
            fresh.mkdir()
            yield fresh
            files = _files_below(fresh)
            if path.exists():
                check_files(path, [*parts, *files], force=force)
                if workspace.parent != path:  # It was not there when the work began.
                    workspace = _moved(workspace, path)
                _decide(workspace, path, files, parts, part_folders, force=force)
            else:
                ledger_of = functools.cache(_ledger)
                for name in files:
                    _note(fresh / name, fresh / name, ledger_of)
                fresh.replace(path)
    except OSError as error:
        raise _cannot_write(path, error) from error
    finally:
        if workspace is not None:
            if (workspace / _DECIDED).exists():  # Interrupted between two renames: there is no way back.
                _take_places(workspace, path, force=force)
            shutil.rmtree(workspace, ignore_errors=True)


def check_place(path: Path, *, parts: Collection[str], force: bool = False) -> None:
    """Find out before long work whether `new_folder` will be able to write; raises as it does."""
    with suppress(_Tried), new_folder(path, parts=parts, force=force):
        raise _Tried


def keep_input(place: Path, given: Path, what: str) -> None:
    """Refuse to replace the files of a folder that is read, or of one that holds it.

    Raises
    ------
    OutputError
        `place`, which `what` names in errors, is the `given` folder or holds it.
    """
    written, read = place.resolve(), given.resolve()
    if written == read or written in read.parents:
        how = "is" if written == read else "holds"
        raise OutputError(
            f"{what} {place}: {how} the dataset that is read, {given}",
            hint="choose another folder: what is given stays as it is",
        )


def check_files(folder: Path, names: Collection[str], *, force: bool = False) -> None:
    """Find out before long work whether files in a folder can be replaced.

    Raises
    ------
    OutputError
        One is there that valuemap did not write, or that was changed since, and `force` does not say to replace it;
        or a folder, a pipe, a socket or a device is in its place.
    """
    for name in names:
        path = folder / name
        if path.parent != folder and path.parent.resolve() != folder.resolve() / Path(name).parent:
            raise OutputError(f"{path}: leads out of {folder} through a link", hint="choose another place")
        if not os.path.lexists(path):
            continue
        if path.is_dir() and not path.is_symlink():
            raise OutputError(f"{path}: is a folder, a file is to be written there", hint="choose another place")
        if not stat.S_ISREG(kind := path.lstat().st_mode) and not stat.S_ISLNK(kind):
            raise OutputError(f"{path}: is a pipe, a socket or a device, not a file", hint="choose another place")
        if not force and not _is_ours(path):
            raise OutputError(
                f"{path}: is not ours to replace: valuemap did not write it, or it was changed since",
                hint="choose another place, or replace it with --force",
            )


def _refuse_other_kind(folder: Path, parts: Collection[str]) -> None:
    """Keep a map from being written over a dataset, and a dataset over a map: some of their files have one name."""
    other = next((head for head in _KIND_OF if head not in parts and (folder / head).exists()), None)
    if other is not None and not _KIND_OF.keys().isdisjoint(parts):
        raise OutputError(f"{folder}: holds {_KIND_OF[other]}, which would be lost", hint="choose another folder")


DATASET_MARKER, MAP_MARKER = "dataset.json", "run.json"
_KIND_OF = {DATASET_MARKER: "a dataset", MAP_MARKER: "a map"}
"""What a folder is, by the file that every such folder has."""


class _Tried(Exception):
    """Leaves `new_folder` before it replaces anything."""


def settle(path: Path) -> None:
    """Finish what a crash interrupted in a folder: go on with what was decided, forget what was not."""
    with suppress(OSError):
        for workspace in sorted(path.glob(f"{_STAGING}*")):
            with suppress(OSError), _locked(workspace):
                if (workspace / _DECIDED).is_dir():
                    _take_places(workspace, path)
                shutil.rmtree(workspace, ignore_errors=True)


@contextmanager
def new_file(path: Path, *, force: bool = False, keep_record: bool = True) -> Iterator[Path]:
    """Yield a temporary file path beside `path` that takes its place when the block ends well.

    Parameters
    ----------
    force
        Replace a file that is not ours, too.
    keep_record
        Note the file in the ledger of its folder. Without, the next call cannot replace it but by force.

    Raises
    ------
    OutputError
        A file is there that valuemap did not write, or that was changed since; or the place cannot be written.
    """
    path = path.absolute()
    temporary = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        if path.is_dir():
            raise OutputError(f"{path}: is a folder, a file is to be written there", hint="name a file in it")
        if path.is_symlink():
            raise OutputError(f"{path}: is a link, which is not replaced", hint="name the file that it leads to")
        check_files(path.parent, [path.name], force=force)
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        if keep_record:
            _note(temporary, path, lambda _: {})
        temporary.replace(path)
    except OSError as error:
        raise _cannot_write(path, error) from error
    finally:
        with suppress(OSError):  # There is none, if it was renamed or never begun.
            temporary.unlink()


def remove_file(path: Path, *, force: bool = False) -> None:
    """Remove a file that valuemap wrote, if it is there; with `force`, whoever wrote it.

    Raises
    ------
    OutputError
        It is there, and somebody else wrote or changed it.
    """
    check_files(path.parent, [path.name], force=force)
    path.unlink(missing_ok=True)


def take_over(files: Mapping[Path, Path]) -> None:
    """Link files that nobody changes any more to places in a folder that `new_folder` yields, or copy them.

    What the ledgers of their folders say of them goes along, so that they are not hashed again. One that was changed
    since is as little ours in its new place as it was before.
    """
    lines: dict[Path, list[tuple[bytes, str]]] = {}
    ledger_of = functools.cache(_ledger)
    for file, place in files.items():
        place.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(file, place)
        except OSError:  # On another disk, or one that knows no links.
            shutil.copyfile(file, place)
        known = ledger_of(file.parent).get(os.fsencode(file.name), set())
        if len(known) == 1:
            lines.setdefault(place.parent, []).append((next(iter(known)), place.name))
    for folder, of_folder in lines.items():
        _write_lines(folder, of_folder)


def _followed(path: Path) -> Path:
    """Return the folder that a path means, through links."""
    path = path.absolute()
    if path.is_symlink() and not path.exists():
        raise OutputError(f"{path}: is a link to nothing", hint="choose another folder, or remove the link")
    if path.exists() and not path.is_dir():
        raise OutputError(f"{path}: is a file, a folder is to be written there", hint="choose another folder")
    return path.resolve() if path.is_symlink() else path


def _workspace_for(path: Path) -> Path:
    """Return a new folder on the file system of `path`: in it, or, where there is none yet, beside it."""
    if path.exists():
        return Path(tempfile.mkdtemp(prefix=_STAGING, dir=path))
    path.parent.mkdir(parents=True, exist_ok=True)
    prefix = f".{path.name[:_NAME_LENGTH]}{_STAGING}"
    for stale in path.parent.glob(f"{prefix}*"):
        with suppress(OSError), _locked(stale):
            shutil.rmtree(stale, ignore_errors=True)
    return Path(tempfile.mkdtemp(prefix=prefix, dir=path.parent))


def _moved(workspace: Path, path: Path) -> Path:
    """Move a workspace into a folder that has come into being beside it."""
    inside = path / f"{_STAGING}{workspace.name.rpartition(_STAGING)[2]}"
    workspace.rename(inside)
    return inside


@contextmanager
def _locked(workspace: Path, *, is_new: bool = False) -> Iterator[None]:
    """Hold the lock of a workspace; raises `OSError` where a living process has it.

    One that is new nobody else can have: where a file system knows no locks, that is as good.
    """
    with ExitStack() as held:
        with suppress(OSError) if is_new else nullcontext():
            held.enter_context(folder_lock(workspace))
        yield


def _decide(
    workspace: Path,
    path: Path,
    files: Collection[str],
    parts: Collection[str],
    part_folders: Collection[str],
    *,
    force: bool,
) -> None:
    """Let the fresh files take the places of the older ones; from the first rename on there is no way back."""
    ledger_of = functools.cache(_ledger)
    for name in files:
        _note(workspace / _FRESH / name, path / name, ledger_of)
        sync_file(workspace / _FRESH / name)
    stale = [name for name in parts if name not in files and os.path.lexists(path / name)]
    for folder in part_folders:
        stale += [name for name in _own_files_below(path, folder) if name not in files]
    (workspace / _STALE).write_bytes(b"".join(os.fsencode(name) + b"\0" for name in stale))
    sync_file(workspace / _STALE)
    (workspace / _FRESH).rename(workspace / _DECIDED)
    _take_places(workspace, path, force=force)


def _take_places(workspace: Path, path: Path, *, force: bool = False) -> None:
    """Remove what is stale and rename what is new: done twice or after an interruption, it comes to the same."""
    ledger_of = functools.cache(_ledger)
    with suppress(FileNotFoundError):
        for name in map(os.fsdecode, (workspace / _STALE).read_bytes().split(b"\0")):
            if name and _is_inside(name) and (force or _is_ours(path / name, ledger_of)):
                (path / name).unlink(missing_ok=True)
    places = set()
    for name in _files_below(workspace / _DECIDED):
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (workspace / _DECIDED / name).replace(path / name)
        places.add((path / name).parent)
    shutil.rmtree(workspace / _DECIDED)
    if list(path.glob(f"{_STAGING}*")) == [workspace]:  # Nobody has noted files that are not in place yet.
        for place in places:
            _shorten(place, workspace / LEDGER)


def _shorten(folder: Path, temporary: Path) -> None:
    """Keep of a ledger one line, the last, for each file that is there: it would grow with each set of files."""
    ledger = folder / LEDGER
    with suppress(OSError):
        before = ledger.stat()
        last = {name: line for line in ledger.read_bytes().splitlines(True) if (name := line.partition(b"  ")[2])}
        lines = [line for name, line in last.items() if os.path.lexists(folder / os.fsdecode(name.rstrip(b"\n")))]
        temporary.write_bytes(b"".join(lines))
        sync_file(temporary)
        if not ledger.is_symlink() and ledger.stat().st_size == before.st_size:  # Nobody has added to it meanwhile.
            temporary.replace(ledger)


def _files_below(folder: Path) -> list[str]:
    """Return the names of the files in a folder and the folders in it, relative to it, in an order of their own."""
    files = (path for path in folder.rglob("*") if path.name != LEDGER and stat.S_ISREG(path.lstat().st_mode))
    return sorted(path.relative_to(folder).as_posix() for path in files)


def _is_inside(name: str) -> bool:
    return not name.startswith("/") and ".." not in name.split("/")


def _is_ours(path: Path, ledger_of: Callable[[Path], dict[bytes, set[bytes]]] | None = None) -> bool:
    """Return whether a file is as valuemap wrote it, by the ledger of its folder, which is read if nobody has."""
    hashes = (ledger_of or _ledger)(path.parent).get(os.fsencode(path.name), set())
    try:
        return bool(hashes) and stat.S_ISREG(path.lstat().st_mode) and _sha256(path) in hashes
    except OSError:
        return False


def _own_files_below(path: Path, folder: str) -> list[str]:
    """Return the names, relative to `path`, of the files below one of its folders that are as valuemap wrote them."""
    if (path / folder).is_symlink():
        return []  # It leads out.
    ledger_of = functools.cache(_ledger)
    places = (Path(place) for place, _, _ in os.walk(path / folder))  # Follows no link.
    files = (place / os.fsdecode(name) for place in places for name in ledger_of(place))
    return sorted(file.relative_to(path).as_posix() for file in files if _is_ours(file, ledger_of))


def _ledger(folder: Path) -> dict[bytes, set[bytes]]:
    """Return the names that a ledger lists, each with all its hashes: the last may not be in place yet."""
    found: dict[bytes, set[bytes]] = {}
    try:
        descriptor = os.open(folder / LEDGER, os.O_RDONLY | OWN_FILE)
    except OSError:
        return found
    with os.fdopen(descriptor, "rb") as file:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            return found
        for line in file:
            digest, _, name = line.rstrip(b"\n").partition(b"  ")
            if len(digest) == hashlib.sha256().digest_size * 2 and name and b"/" not in name:
                found.setdefault(name, set()).add(digest)
    return found


def _note(content: Path, place: Path, ledger_of: Callable[[Path], dict[bytes, set[bytes]]]) -> None:
    """Add a file to the ledger of the folder that it is to be in, before it is there.

    A hash that the ledger of the folder where it is now lists already is not made again.
    """
    known = ledger_of(content.parent).get(os.fsencode(content.name), set())
    if not known or content != place:
        _write_lines(place.parent, [(next(iter(known)) if len(known) == 1 else _sha256(content), place.name)])


def _write_lines(folder: Path, lines: Iterable[tuple[bytes, str]]) -> None:
    """Add hashes of files, by their names, to the ledger of a folder, which is made if it is not there."""
    content = b""
    for digest, name in lines:
        if "\n" in name:
            raise OutputError(
                f"{folder / name}: a line break in a name cannot be kept on record", hint="choose another name"
            )
        content += digest + b"  " + os.fsencode(name) + b"\n"
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(folder / LEDGER, os.O_WRONLY | os.O_CREAT | os.O_APPEND | OWN_FILE, 0o666)
    try:
        os.write(descriptor, content)
    finally:
        os.close(descriptor)


def _sha256(path: Path) -> bytes:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest().encode()


def _cannot_write(path: Path, error: OSError) -> OutputError:
    reason = error.strerror or str(error)
    return OutputError(f"{path}: cannot be written: {reason}", hint="check the folder's permissions and free space")


def why_not_there(folder: Path, marker: str) -> str:
    """Return in words why a folder, which a file `marker` would mark as ours, is not there."""
    if folder.is_dir():
        return f"there is no {marker} in it"
    return "it is a file" if folder.exists() else "there is no such folder"
