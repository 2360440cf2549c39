"""Carries messages between a run and the process of its plugin: a JSON header and plain arrays, nothing else.

A message is the length of its header and of its body (two little-endian u64), the header, and the body: arrays one
after the other, each at a multiple of 64 bytes. A large body goes to the plugin's process as shared memory that both
map, so that a fit copies its data once. The other way everything is read from the socket: the run maps no memory that
the plugin could change or cut off under it.
"""

from __future__ import annotations

import json
import math
import mmap
import os
import re
import socket
import struct
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dlobench.trajectories import Query, Trajectories

Arrays = dict[str, NDArray[Any]]

TICK = 0.1  # s, between two looks at the other side while it is waited for
HEADER = 2**26  # bytes of a header, at most
INLINE = 2**20  # bytes of a body that goes through the socket rather than through shared memory
_ALIGN = 64  # bytes
_LENGTHS = struct.Struct("<QQ")
_DTYPE = re.compile(r"[<>|=][fiub]\d{1,2}")


class GarbledError(Exception):
    """Says that what came through the socket is no message."""


class Wire:
    """Sends and receives over a socket. `look` is called while it waits, and raises to end the waiting."""

    def __init__(self, sock: socket.socket, look: Callable[[], None] | None = None) -> None:
        self.look = look
        self._socket, self._looked = sock, 0.0
        sock.settimeout(None if look is None else TICK)

    def close(self) -> None:
        """Closes the socket."""
        self._socket.close()

    def send(self, header: Mapping[str, Any], arrays: Arrays | None = None, *, share: bool = False) -> None:
        """Sends a message; with `share` a body beyond `INLINE` goes as shared memory. Raises `OSError`."""
        rows, places, end = [], list[tuple[int, NDArray[Any]]](), 0
        for name, array in (arrays or {}).items():
            whole = np.ascontiguousarray(array).reshape(array.shape)
            places.append((end, whole))
            rows.append([name, whole.dtype.str, whole.shape, end])
            end += -(-whole.nbytes // _ALIGN) * _ALIGN
        shared = share and end > INLINE
        text = json.dumps({"arrays": rows, "shared": shared, **header}).encode()
        start = _LENGTHS.pack(len(text), end)
        if shared:
            file = _memory()
            try:
                os.ftruncate(file, end)
                for place, array in places:
                    _write(file, place, array)
                self._push(start, [file])
                self._push(text)
            finally:
                os.close(file)
        else:
            body = bytearray(end)
            for place, array in places:
                body[place : place + array.nbytes] = array.reshape(-1).view(np.uint8).data
            self._push(start + text + body)

    def receive(self, most: int | None = None) -> tuple[dict[str, Any], Arrays]:
        """Returns the next message's header and arrays, which may be written into.

        A receiver that trusts the other side gives no `most`, and maps what is shared. Raises `EOFError` when the
        socket is closed, `GarbledError` for no message and for a body of more than `most` bytes.
        """
        start, file = bytearray(_LENGTHS.size), -1
        if most is None:
            first, files, _, _ = socket.recv_fds(self._socket, len(start), 1)
            file = files[0] if files else -1
            if not first:
                raise EOFError
            start[: len(first)] = first
            self._fill(memoryview(start)[len(first) :])
        else:
            self._fill(memoryview(start))
        length, size = _LENGTHS.unpack(start)
        if length > HEADER or (most is not None and size > most):
            raise GarbledError(f"a message of {length} + {size} bytes")
        text = bytearray(length)
        self._fill(memoryview(text))
        try:
            header = json.loads(text)
            if header["shared"] and file >= 0:
                body = np.frombuffer(mmap.mmap(file, size), np.uint8)
            elif header["shared"]:
                raise ValueError("no memory is shared")
            else:
                body = np.empty(size, np.uint8)
                self._fill(body.data)
            return header, {str(row[0]): _array(body, *row[1:]) for row in header["arrays"]}
        except (ValueError, TypeError, KeyError, IndexError, RecursionError, AttributeError) as error:
            raise GarbledError(f"{type(error).__name__}: {error}") from error
        finally:
            if file >= 0:
                os.close(file)

    def _push(self, content: bytes, files: list[int] | None = None) -> None:
        rest = memoryview(content)
        while rest:
            self._watch()
            try:
                sent = socket.send_fds(self._socket, [rest], files) if files else self._socket.send(rest)
            except TimeoutError:
                continue
            rest, files = rest[sent:], None

    def _fill(self, rest: memoryview) -> None:
        while rest:
            self._watch()
            try:
                got = self._socket.recv_into(rest)
            except TimeoutError:
                continue
            if not got:
                raise EOFError
            rest = rest[got:]

    def _watch(self) -> None:
        if self.look is not None and time.monotonic() - self._looked > TICK:
            self.look()
            self._looked = time.monotonic()


def unpacked(cls: type[Any], arrays: Arrays, prefix: str = "") -> Any:
    """Returns the `Query` or `Trajectories` whose fields are among arrays under a prefix."""
    return cls(**{f.name: arrays[prefix + f.name] for f in fields(cls) if prefix + f.name in arrays})


def packed(what: Query | Trajectories, prefix: str = "") -> Arrays:
    """Returns the fields of what a model may see by name; the cylinder is never among them."""
    values = {f.name: getattr(what, f.name) for f in fields(what) if f.name != "cylinder"}
    return {prefix + name: value for name, value in values.items() if value is not None}


def _memory() -> int:
    if hasattr(os, "memfd_create"):
        return os.memfd_create("dlobench")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def _write(file: int, place: int, array: NDArray[Any]) -> None:
    rest = array.reshape(-1).view(np.uint8).data
    while rest:
        done = os.pwrite(file, rest, place)
        rest, place = rest[done:], place + done


def _array(body: NDArray[np.uint8], dtype: str, shape: list[int], place: int) -> NDArray[Any]:
    if not _DTYPE.fullmatch(dtype) or not all(type(n) is int and n >= 0 for n in (*shape, place)):
        raise ValueError(f"an array of {dtype} and {shape}")
    return np.frombuffer(body, dtype, math.prod(shape), place).reshape(shape)
