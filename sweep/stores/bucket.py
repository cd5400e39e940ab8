"""A store in a bucket: the same files as in a folder, as objects of S3 or of any server with its interface."""

import os
import re
import time
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from datetime import timedelta
from functools import cached_property
from ipaddress import ip_address
from urllib.parse import urlsplit

import obstore
from obstore import exceptions
from obstore.exceptions import AlreadyExistsError, PreconditionError
from obstore.store import S3Store

from linksweep.sweep.contract import SweepError

AT_ONCE = 16
"""Requests under way at a time: an answer takes tens of milliseconds, whatever its size."""

TIMEOUT = timedelta(seconds=15)
"""How long a request is tried again after dropped connections and errors of the server."""

ADDRESS = re.compile(r"s3:/{1,2}(?P<bucket>[a-z0-9][a-z0-9.-]{1,61}[a-z0-9])/+(?P<prefix>[^/].*?)/*")


def bucket_at(address: str) -> "Bucket":
    """Return the place that an address ``s3://BUCKET/NAME`` names; raises SweepError for any other address."""
    found = ADDRESS.fullmatch(address)
    if found is None or any(part in ("", ".", "..") for part in found["prefix"].split("/")):
        raise SweepError(
            "cannot be a store: its address must be s3://BUCKET/NAME, with a bucket of 3 to 63 small letters, digits, "
            "dots and dashes",
            address,
        )
    return Bucket(found["bucket"], found["prefix"])


@dataclass(frozen=True)
class Bucket:
    """All objects of a bucket whose names begin with a prefix and a slash; credentials and endpoint are those of the
    usual environment variables.
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
    def objects(self) -> S3Store:
        """The bucket under the prefix, as a store of obstore; Zarr's ObjectStore takes it too."""
        return S3Store(
            self.bucket,
            prefix=self.prefix or None,
            client_options={
                "allow_http": _is_loopback() or os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true"),
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
        with self._errors(missing_is_none=True):
            return bytes(obstore.get(self.objects, key).bytes())
        return None

    def get_all(self, keys: Iterable[str]) -> dict[str, bytes | None]:
        """Return the contents of objects, some at a time."""
        names = list(keys)
        with ThreadPoolExecutor(AT_ONCE) as pool:
            return dict(zip(names, pool.map(self.get, names), strict=True))

    def put(self, key: str, content: bytes) -> None:
        """Write or replace an object."""
        with self._errors():
            obstore.put(self.objects, key, content)

    def put_all(self, files: Mapping[str, bytes]) -> None:
        """Write objects, some at a time."""
        with ThreadPoolExecutor(AT_ONCE) as pool:
            list(pool.map(self.put, files.keys(), files.values()))

    def create(self, key: str, content: bytes) -> bool:
        """Write an object unless there is one: a put that the server refuses in that case."""
        with suppress(AlreadyExistsError, PreconditionError), self._errors():
            obstore.put(self.objects, key, content, mode="create")
            return True
        return False

    def swap(self, key: str, old: bytes, new: bytes) -> bool:
        """Replace an object if it still holds ``old``: a put that the server refuses if it has changed since it was
        read.
        """
        with suppress(PreconditionError), self._errors(missing_is_none=True):
            answer = obstore.get(self.objects, key)
            if bytes(answer.bytes()) == old:
                obstore.put(self.objects, key, new, mode={"e_tag": answer.meta["e_tag"]})
                return True
        return False

    def delete(self, key: str) -> None:
        """Remove an object if there is one.

        S3 deletes by a POST, which obstore does not repeat after a broken connection, since it cannot know that this
        one may be repeated.
        """
        until = time.monotonic() + TIMEOUT.total_seconds()
        while True:
            try:
                with self._errors(missing_is_none=True):
                    obstore.delete(self.objects, key)
                return
            except OSError as error:
                if isinstance(error, FileNotFoundError) or time.monotonic() > until:  # the first: no such bucket
                    raise
                time.sleep(0.2)

    def clear(self) -> None:
        """Remove all objects."""
        for key in self.keys():
            self.delete(key)

    def keys(self, under: str = "") -> list[str]:
        """Return the names of all objects that begin with ``under``."""
        with self._errors():
            return sorted(entry["path"] for page in obstore.list(self.objects, under or None) for entry in page)

    def require_plain(self) -> None:
        """Do nothing, since a bucket has no links."""

    def is_free(self) -> bool:
        """Return whether there is no object."""
        with self._errors():
            return not any(page for page in obstore.list(self.objects, chunk_size=1))

    def obstacle(self) -> str | None:
        """Return None: nothing can be told without an attempt to write."""
        return None

    def tidied(self) -> AbstractContextManager[None]:
        """Do nothing, since a bucket has no folders."""
        return nullcontext()

    @contextmanager
    def _errors(self, *, missing_is_none: bool = False) -> Iterator[None]:
        """Turn the errors of a request into an OSError with one sentence.

        A failed precondition is left to the caller.
        """
        try:
            yield
        except (AlreadyExistsError, PreconditionError):
            raise
        except (exceptions.BaseError, FileNotFoundError) as error:
            if "NoSuchBucket" in str(error):
                raise FileNotFoundError(f"there is no bucket {self.bucket!r}") from error
            if not isinstance(error, FileNotFoundError):
                raise OSError(_explained(error)) from error
            if not missing_is_none:
                raise


def _explained(error: Exception) -> str:
    text = str(error)
    endpoint = _endpoint() or "AWS"
    if isinstance(error, exceptions.PermissionDeniedError | exceptions.UnauthenticatedError):
        return f"{endpoint} refuses these credentials (AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY)"
    if "169.254.169.254" in text or "/latest/api/token" in text:  # where a machine of AWS would find them
        return "there are no credentials; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
    if "BadScheme" in text:
        return f"{endpoint} is not encrypted; AWS_ALLOW_HTTP=true allows that"
    reason = text.strip().splitlines()[0].rpartition(" - ")[2]
    return f"{endpoint} does not answer as it should: {reason[:300]}"


def _endpoint() -> str:
    return os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""


def _is_loopback() -> bool:
    host = urlsplit(_endpoint()).hostname or ""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
