"""Where a store is, a folder of this machine or a prefix in a bucket, and who may write there.

Both kinds of places have files with names like ``a/b/c``, and three ways to write one: replace it in one step (`put`),
make it only if there is none (`create`), replace it only if it has not changed (`swap`).  Ledger, dataset and lock need
nothing else.
"""

import fcntl
import json
import os
import platform
import re
import shutil
import stat
import time
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime, timedelta
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal
from uuid import uuid4

from linksweep.sweep.contract import SweepError, needed, refused
from linksweep.sweep.stores.integrity import MOST_BYTES

if TYPE_CHECKING:
    from obstore.store import S3Store

# Ends the name of the file that stands for the system's lock where there is none.
TAKING = ".taking"

# Ends the name of a file that is being written.
UNFINISHED = ".partial"

# The folder where a run puts its store by default.
RESULTS = Path("results")

# Requests to a bucket under way at a time: an answer takes tens of milliseconds, whatever its size.
AT_ONCE = 16

# How long a request to a bucket is tried again after dropped connections and errors of the server.
TIMEOUT = timedelta(seconds=15)

# Settings with which a request was tried again for so long, until when no other is tried, and why: a run that stops
# does not wait for each of its last requests.
DOWN: dict[frozenset[tuple[str, str]], tuple[float, str]] = {}

# The process that has made requests: a fork of it has none of obstore's threads, and would wait for ever.
USED_BY: set[int] = set()

ADDRESS = re.compile(r"s3:/{1,2}(?P<bucket>[a-z0-9][a-z0-9.-]{1,61}[a-z0-9])/+(?P<prefix>[^/].*?)/*")

# How often, and after which pause, a process tries to take a lock that others take at the same time.
ATTEMPTS, PAUSE_S = 100, 0.02


@dataclass(frozen=True)
class Folder:
    """A folder of this machine; `get` and the like take the names of files in it, as ``a/b/c``."""

    path: Path
    named: str = field(init=False, compare=False)

    def __post_init__(self) -> None:
        """Let the path name the same folder whatever becomes the working folder; ``named`` is what it was given as."""
        object.__setattr__(self, "named", str(self.path))
        object.__setattr__(self, "path", self.path.absolute())

    def __str__(self) -> str:
        return self.named

    @property
    def name(self) -> str:
        """The folder's own name, whatever links lead to it: two names of one store have one lock."""
        return _key(os.path.basename(os.path.realpath(self.path)))

    @property
    def parent(self) -> "Folder":
        """The folder around it."""
        # Path.resolve raises where links form a loop.
        return Folder(Path(os.path.realpath(self.path)).parent)

    def get(self, key: str) -> bytes | None:
        """Return the content of a file, None where there is none."""
        with suppress(FileNotFoundError, NotADirectoryError):
            path = self._at(key)
            if path.stat().st_size > MOST_BYTES:
                raise OSError(f"{key} is larger than linksweep writes a file")
            return path.read_bytes()
        return None

    def get_all(self, keys: Iterable[str]) -> dict[str, bytes | None]:
        """Return the contents of files."""
        return {key: self.get(key) for key in keys}

    def put(self, key: str, content: bytes) -> None:
        """Write a file by renaming a finished one, and wait until it and its name are on the disk."""
        path = self._write(key, content, durable=True)
        # A rename is lost with the power unless the folder, too, is written: its entry is what names the new content.
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

    def put_all(self, files: Mapping[str, bytes]) -> None:
        """Write files one by one, each in one step too, but without waiting for the disk."""
        for key, content in files.items():
            self._write(key, content, durable=False)

    def copy_all(self, names: Mapping[str, str]) -> None:
        """Give files other names; a file system without links, or with no more for a file, copies them."""
        for key, old in names.items():
            self.delete(key)
            self._at(key).parent.mkdir(parents=True, exist_ok=True)
            _link(self._at(old), self._at(key))

    def create(self, key: str, content: bytes) -> bool:
        """Write a file unless there is one, by linking a finished one to its name; return whether it was written."""
        path = self._at(key)
        with _finished(path, content, durable=True) as temporary, suppress(FileExistsError):
            # A link fails where the name exists, and brings the whole content with it: no reader sees half a lock.
            _link(temporary, path)
            return True
        return False

    def swap(self, key: str, old: bytes, new: bytes) -> bool:
        """Replace a file if it still holds ``old``; of two processes that try, only one succeeds.  Return whether it
        was replaced.
        """
        path = self._at(key)
        guard = path.with_name(f"{path.name}{TAKING}")
        with suppress(FileNotFoundError, FileExistsError), path.open("rb") as file, ExitStack() as stack:
            try:
                fcntl.flock(file, fcntl.LOCK_EX)
            except OSError:
                # Some network disks have no locks; a file that only one process can make has to do.
                guard.touch(exist_ok=False)
                stack.callback(guard.unlink, missing_ok=True)
            # Who waited for the lock of a file that was replaced meanwhile does not hold that of the new one.
            if self.get(key) == old and os.path.samestat(os.fstat(file.fileno()), path.stat()):
                self._write(key, new, durable=True)
                return True
        return False

    def delete(self, *keys: str) -> None:
        """Remove files that are there, and the folders of arrays of which nothing is left, one after the other."""
        for key in keys:
            path = self._at(key)
            path.unlink(missing_ok=True)
            if "/" in key:
                with suppress(OSError):
                    path.parent.rmdir()

    def clear(self) -> None:
        """Remove the folder with all that is in it."""
        shutil.rmtree(os.path.realpath(self.path))

    def keys(self, under: str = "") -> list[str]:
        """Return the names of all finished files that begin with ``under``, a name with a slash at its end or empty.

        Raises OSError as `require_plain`.
        """

        def unless_missing(error: OSError) -> None:
            if not isinstance(error, FileNotFoundError | NotADirectoryError):
                raise error

        keys: list[str] = []
        for folder, folders, names in os.walk(self._at(under), onerror=unless_missing):
            relative = Path(folder).relative_to(self.path)
            for name in (*folders, *names):
                _refuse_special(os.path.join(folder, name), (relative / name).as_posix())
            keys += [_key((relative / name).as_posix()) for name in names if not name.endswith(UNFINISHED)]
        return sorted(keys)

    def require_plain(self) -> None:
        """Raise OSError where something inside is neither a file nor a folder."""
        self.keys()

    def beside(self) -> list[str]:
        """Return the names of what is in the folder around it."""
        return sorted(map(_key, os.listdir(self.parent.path))) if self.parent.path.is_dir() else []

    def is_free(self) -> bool:
        """Return whether nothing is there, or a folder with nothing but files that a killed process did not finish."""
        if not self.path.exists():
            return not self.path.is_symlink()
        return self.path.is_dir() and all(p.name.endswith(UNFINISHED) and p.is_file() for p in self.path.iterdir())

    @contextmanager
    def tidied(self) -> Iterator[None]:
        """Remove folders that were not there before and are empty now."""
        # The lock beside a store makes `results/` even for a run that is refused a moment later.
        # No error where a name is too long.
        missing = [folder for folder in (self.path, *self.path.parents) if not os.path.exists(folder)]
        try:
            yield
        finally:
            with suppress(OSError):
                for folder in missing:
                    folder.rmdir()

    def _at(self, key: str) -> Path:
        """Return where a file is or will be; raises OSError where that, or a folder on the way to it, is special."""
        # Every folder on the way, since a link anywhere leads outside; `resolve` would follow it.
        file = file_named(key)
        names = file.rstrip("/").split("/")
        for number in range(1, len(names) + 1):
            name = "/".join(names[:number])
            _refuse_special(os.path.join(self.path, name), name)
        return self.path / file

    def _write(self, key: str, content: bytes, *, durable: bool) -> Path:
        path = self._at(key)
        with _finished(path, content, durable=durable) as temporary:
            temporary.replace(path)
        return path


@contextmanager
def _finished(path: Path, content: bytes, *, durable: bool) -> Iterator[Path]:
    """Give a temporary file beside ``path`` with this content; it is removed afterwards unless it was renamed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.{uuid4().hex[:12]}{UNFINISHED}")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        yield temporary
    finally:
        temporary.unlink(missing_ok=True)


def _link(path: Path, name: Path) -> None:
    """Give a file another name; a file system without links, or with no more for a file, copies it.  Raises
    FileExistsError where the name exists.
    """
    try:
        os.link(path, name)
    except FileExistsError:
        raise
    except OSError:
        with name.open("xb") as file:
            file.write(path.read_bytes())


def file_named(key: str) -> str:
    """Return what this process calls a file: its name is UTF-8 on the disk, whatever the encoding of the locale."""
    return os.fsdecode(key.encode("utf-8", "surrogateescape"))


def _key(file: str) -> str:
    return os.fsencode(file).decode("utf-8", "surrogateescape")


def _refuse_special(path: str, name: str) -> None:
    # Who follows a link in a store that came from elsewhere reads, or overwrites, what lies outside.
    try:
        mode = os.lstat(path).st_mode
    except OSError:
        # Nothing is there, or reading it will say why it cannot be.
        return
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        kind = "a symbolic link" if stat.S_ISLNK(mode) else "a pipe, a socket or a device"
        raise OSError(f"{name} is {kind}, which is neither read nor written through; remove it")


@dataclass(frozen=True)
class Bucket:
    """All objects of a bucket of S3, or of a server with its interface, whose names begin with a prefix and a slash;
    credentials and endpoint are those of the usual environment variables.
    """

    bucket: str
    prefix: str

    def __str__(self) -> str:
        return f"s3://{self.bucket}/{self.prefix}".rstrip("/")

    @property
    def name(self) -> str:
        """The last part of the prefix."""
        return self.prefix.rpartition("/")[2]

    @property
    def parent(self) -> "Bucket":
        """What is around the prefix."""
        return Bucket(self.bucket, self.prefix.rpartition("/")[0])

    @cached_property
    def objects(self) -> "S3Store":
        """The bucket under the prefix, as a store of obstore; Zarr's ObjectStore takes it too."""
        from obstore.store import S3Store
        from pydantic import HttpUrl, TypeAdapter

        for name in [name for name, value in os.environ.items() if name.startswith("AWS_") and not value]:
            del os.environ[name]  # obstore takes an empty one for an address
        try:  # obstore panics
            host = TypeAdapter(HttpUrl).validate_python(_endpoint() or "https://amazonaws.com").host
        except ValueError as error:
            raise OSError(f"AWS_ENDPOINT_URL is {_endpoint()!r}, not an address as http://HOST:PORT") from error
        is_here = host in ("localhost", "127.0.0.1", "[::1]")
        return S3Store(
            self.bucket,
            prefix=self.prefix or None,
            client_options={
                "allow_http": is_here or os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true"),
                # So that a server which drops packets is tried three times.
                "connect_timeout": TIMEOUT / 3,
                "timeout": timedelta(seconds=60),
            },
            retry_config={
                "max_retries": 100,
                "retry_timeout": TIMEOUT,
                "backoff": {"init_backoff": timedelta(seconds=0.1), "max_backoff": timedelta(seconds=2), "base": 2},
            },
        )

    def get(self, key: str) -> bytes | None:
        """Return the content of an object, None where there is none."""
        with suppress(FileNotFoundError), self._request():
            return bytes(self.objects.get(key).bytes())
        return None

    def get_all(self, keys: Iterable[str]) -> dict[str, bytes | None]:
        """Return the contents of objects, some at a time."""
        # Threads and not asyncio: a notebook runs its own loop.
        names = list(keys)
        with ThreadPoolExecutor(AT_ONCE) as pool:
            return dict(zip(names, pool.map(self.get, names), strict=True))

    def put(self, key: str, content: bytes) -> None:
        """Write or replace an object."""
        with self._request():
            self.objects.put(key, content)

    def put_all(self, files: Mapping[str, bytes]) -> None:
        """Write objects, some at a time."""
        with ThreadPoolExecutor(AT_ONCE) as pool:
            list(pool.map(self.put, files.keys(), files.values()))

    def copy_all(self, names: Mapping[str, str]) -> None:
        """Copy objects to other names, some at a time."""
        with ThreadPoolExecutor(AT_ONCE) as pool, self._request():
            list(pool.map(self.objects.copy, names.values(), names.keys()))

    def create(self, key: str, content: bytes) -> bool:
        """Write an object unless there is one: a put that the server refuses in that case."""
        with suppress(FileExistsError), self._request():
            self.objects.put(key, content, mode="create")
            return True
        return False

    def swap(self, key: str, old: bytes, new: bytes) -> bool:
        """Replace an object if it still holds ``old``: a put that the server refuses if it was written since then."""
        with suppress(FileExistsError, FileNotFoundError), self._request():
            answer = self.objects.get(key)
            if bytes(answer.bytes()) == old:
                self.objects.put(key, new, mode={"e_tag": answer.meta["e_tag"]})
                return True
        return False

    def delete(self, *keys: str) -> None:
        """Remove objects that are there, one after the other."""
        for key in keys:
            # S3 deletes by a POST, which obstore does not repeat after a broken connection, since it cannot know that
            # this one may be repeated.
            begun, is_there = time.monotonic(), True
            while is_there:
                try:
                    with suppress(FileNotFoundError), self._request(begun):
                        self.objects.delete(key)
                    is_there = False
                except OSError:
                    if _given_up():
                        raise
                    time.sleep(0.2)

    def clear(self) -> None:
        """Remove all objects."""
        self.delete(*self.keys())

    def keys(self, under: str = "") -> list[str]:
        """Return the names of all objects that begin with ``under``."""
        with self._request():
            return sorted(entry["path"] for page in self.objects.list(under or None) for entry in page)

    def require_plain(self) -> None:
        """Do nothing, since a bucket has no links."""

    def beside(self) -> list[str]:
        """Return the names of all prefixes beside this one."""
        with self._request():
            listed = self.parent.objects.list_with_delimiter()
        return sorted(prefix.rstrip("/").rpartition("/")[2] for prefix in listed["common_prefixes"])

    def is_free(self) -> bool:
        """Return whether there is no object."""
        with self._request():
            return not any(page for page in self.objects.list(chunk_size=1))

    def tidied(self) -> AbstractContextManager[None]:
        """Do nothing, since a bucket has no folders."""
        return nullcontext()

    @contextmanager
    def _request(self, begun: float = 0.0) -> Iterator[None]:
        """Turn the errors of a request, tried for the first time when it was ``begun``, into those that a file would
        raise, with one sentence.
        """
        from obstore import exceptions

        begun = begun or time.monotonic()
        if why := _given_up():
            raise OSError(why)
        USED_BY.add(os.getpid())
        try:
            yield
        except (exceptions.AlreadyExistsError, exceptions.PreconditionError) as error:
            raise FileExistsError(str(error)) from error
        except (exceptions.BaseError, FileNotFoundError) as error:
            if "NoSuchBucket" in str(error):
                raise OSError(f"there is no bucket {self.bucket!r}") from error
            if isinstance(error, FileNotFoundError):
                raise
            is_refused = isinstance(error, exceptions.PermissionDeniedError | exceptions.UnauthenticatedError)
            why, ended = _explained(str(error), is_refused), time.monotonic()
            if ended - begun > TIMEOUT.total_seconds() * 0.8:
                DOWN[_settings()] = ended + TIMEOUT.total_seconds(), why
            raise OSError(why) from error


def _explained(text: str, is_refused: bool) -> str:
    endpoint = _endpoint() or "AWS"
    if is_refused:
        return f"{endpoint} refuses these credentials (AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY)"
    if re.search(r"169\.254\.169\.254|/latest/api/token|Missing (SecretAccessKey|AccessKeyId)", text):
        # Where a machine of AWS would find them.
        return "there are no credentials; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
    if "BadScheme" in text:
        return f"{endpoint} is not encrypted; AWS_ALLOW_HTTP=true allows that"
    reason = text.strip().splitlines()[0].rpartition(" - ")[2]
    return f"{endpoint} does not answer as it should: {reason[:300]}"


def _given_up() -> str:
    if USED_BY - {os.getpid()}:
        return "a fork of a process that has used a bucket cannot use one"
    until, why = DOWN.get(_settings(), (0.0, ""))
    return why if time.monotonic() < until else ""


def _settings() -> frozenset[tuple[str, str]]:
    return frozenset((name, value) for name, value in os.environ.items() if name.startswith("AWS_") and value)


def _endpoint() -> str:
    names = ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT")
    return next(filter(None, map(os.environ.get, names)), "")


# A place for the files of a store.  Both kinds have the same methods, which raise OSError where they fail.
Location = Folder | Bucket

# What may name a place: an address as a user writes it, a path, or the place itself.
Where = str | Path | Location


def located(where: Where) -> Location:
    """Return the place that an address or path names; raises SweepError for what is none, for an address of no known
    kind, and for a bucket where obstore is not installed.
    """
    if isinstance(where, Location):
        return where
    address = str(where)
    if not isinstance(where, str | Path) or not address:
        rule = "it must be a path, or a text like s3://BUCKET/NAME; a dictionary of axes is axes={...}"
        raise SweepError(f"cannot be a store: {rule}", address or "''")
    if address.startswith("s3:/"):
        # `Path` makes one slash of two.
        match = ADDRESS.fullmatch(address)
        if match is None or any(part in ("", ".", "..") for part in match["prefix"].split("/")):
            rule = "with a bucket of 3 to 63 small letters, digits, dots and dashes, and no //, /./, /../ or line break"
            raise SweepError(f"cannot be a store: its address must be s3://BUCKET/NAME, {rule}", address)
        with needed("obstore", "s3", address):
            import obstore  # noqa: F401 (only to see whether it is there)
        return Bucket(match["bucket"], match["prefix"])
    scheme, separator, _ = address.partition(":/")
    if separator and "/" not in scheme:
        raise SweepError(f"cannot be a store: {scheme}:// is not known; a store is a path or s3://BUCKET/NAME", address)
    return Folder(Path(os.path.expanduser(Path(where))))  # a home that nobody has is a name


def reading(location: Location | Path, failed: str = "cannot be read", more: str = "") -> AbstractContextManager[None]:
    """Turn an OSError into a SweepError that says that a store or a file cannot be read, or what else has failed."""
    return refused(OSError, said=f"{failed}: ", where=location, more=more)


def writing(location: Location) -> AbstractContextManager[None]:
    """Turn an OSError into a SweepError that says that the store cannot be written, and that nothing is lost."""
    return reading(location, "cannot be written", "; what was finished before is kept, and the same command goes on")


def default_store(name: str) -> Path:
    """Return where the store of a study is by default."""
    return RESULTS / f"{name}.zarr"


def store_named(where: Where) -> Location:
    """Return the place that an address, a path or the name of a study names; an existing path takes precedence."""
    if isinstance(where, str) and Path(where).name == where:
        # A path with a folder is never a name.
        default = default_store(where.removesuffix(".toml"))
        with suppress(OSError, ValueError):
            # There are names that no file can have.
            if not Path(where).exists() and default.exists():
                return located(default)
    return located(where)


def short_name(store: Location) -> str:
    """Return the shortest text that `store_named` takes for a store."""
    text = str(store)
    name = Path(text).name.removesuffix(".zarr")
    return name if Path(text) == default_store(name) and not Path(name).exists() else text


@dataclass(frozen=True)
class Holder:
    """Who holds the lock of a store: the content of the file ``STORE.lock`` beside it.

    ``boot`` distinguishes hosts of the same name, and processes before and after a restart; ``started``, in ticks of
    the kernel since the boot, distinguishes a process from a later one with the same number.  Both are empty where the
    system has no /proc.
    """

    host: str
    boot: str
    pid: int
    started: str
    since: str
    token: str

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}, since {self.since}"

    def state(self) -> Literal["runs", "has ended", "cannot be judged"]:
        """Say whether the holder runs, as far as that can be told on this host."""
        # Process numbers mean nothing elsewhere: another host, a container with a namespace of its own, after a reboot.
        if (self.host, self.boot) != _this_host():
            return "cannot be judged"
        if self.started:
            return "runs" if _start_of(self.pid) == self.started else "has ended"
        import psutil

        return "runs" if psutil.pid_exists(self.pid) else "has ended"


@contextmanager
def locked(where: Where, *, break_lock: bool = False) -> Iterator[None]:
    """Hold the lock of a store; raises SweepError that names the holder where another process has it.

    The lock of a process on this host that has ended is taken over.  Whether one on another host runs cannot be told
    from here: ``break_lock`` takes it from such a holder, never from another process that runs on this host.
    """
    location = located(where)
    since = datetime.now(UTC).isoformat(timespec="seconds")
    mine = Holder(*_this_host(), os.getpid(), _start_of(os.getpid()), since, uuid4().hex)
    with location.parent.tidied():
        with reading(location, f"cannot be written: {_lock_of(location)}"):
            _take(location, mine, break_lock)
        try:
            yield
        finally:
            with suppress(OSError):
                # The next run finds that this process has ended.
                # Who was broken with --break-lock must leave the lock of the next one.
                if _parsed(location.parent.get(_lock_of(location))) == mine:
                    location.parent.delete(_lock_of(location))


def holder(where: Where) -> Holder | None:
    """Return who holds the lock of a store, None where nobody does or its process is known to have ended."""
    location = located(where)
    with reading(location, f"its lock {_lock_of(location)} cannot be read"):
        other = _parsed(location.parent.get(_lock_of(location)))
    return None if other is None or other.state() == "has ended" else other


def _take(location: Location, mine: Holder, break_lock: bool) -> None:
    key, content = _lock_of(location), json.dumps(asdict(mine), indent=1).encode()
    for _ in range(ATTEMPTS):
        if location.parent.create(key, content):
            return
        other = location.parent.get(key)
        if other == content:
            # A request that was repeated after its answer was lost.
            return
        if other is not None:
            # Else it was released just now.
            _refuse_unless_free(location, _parsed(other), break_lock)
            if location.parent.swap(key, other, content):
                return
            # Another process takes it over.
            time.sleep(PAUSE_S)
    raise SweepError(
        f"its lock {key} keeps changing hands; if no other process runs there, remove {key} and {key}{TAKING}",
        str(location),
    )


def _refuse_unless_free(location: Location, other: Holder | None, break_lock: bool) -> None:
    state = "is damaged" if other is None else other.state()
    is_own = other is not None and other.pid == os.getpid()
    if state == "has ended" or (break_lock and (state != "runs" or is_own)):
        return
    problem = f"its lock {_lock_of(location)} beside it is damaged" if other is None else f"is being written by {other}"
    more = (
        "; whether it is still written to cannot be told from here: if not, the same command with --break-lock goes on"
    )
    if state == "runs":
        more = "; --break-lock is only for a lock whose process has ended" if break_lock else ""
    raise SweepError(f"{problem}{more}", str(location))


def _lock_of(location: Location) -> str:
    return f"{location.name}.lock"


def _parsed(content: bytes | None) -> Holder | None:
    with suppress(ValueError, TypeError):
        return Holder(**json.loads(content or b""))
    return None


def _this_host() -> tuple[str, str]:
    """Return the host's name, and what identifies the boot of its kernel and the PID namespace of this process."""
    boot = ""
    with suppress(OSError):
        boot = f"{Path('/proc/sys/kernel/random/boot_id').read_text().strip()} {Path('/proc/self/ns/pid').readlink()}"
    return platform.node(), boot


def _start_of(pid: int) -> str:
    """Return when a running process was started, in ticks since the boot; empty where no such process runs."""
    try:
        state, *rest = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return ""
    # A zombie computes nothing any more.  The name before the bracket may hold blanks, hence the count from there.
    return "" if state in "ZX" else rest[18]
