"""What a kernel takes of a GPU, read from its machine code (a cubin, which is an ELF object).

The section .nv.info is a list of attributes, each 4 bytes (format, number, size) and a value. Two of them are pairs of a symbol and
a number: registers, and bytes of local memory, per thread. Static shared memory is the size of the section .nv.shared.KERNEL.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

REGISTERS, STACK = 0x2F, 0x12
"""Numbers of the attributes."""
SIZED = 4
"""The format of an attribute whose value follows; others hold theirs in place of a size."""
RESERVED = 1024
"""Bytes of shared memory that CUDA keeps for itself in every block, from sm_90 on, and counts in."""


class Resources(NamedTuple):
    """What one kernel takes."""

    registers: int
    """Per thread."""
    shared: int
    """Static shared memory per block, bytes."""
    stack: int
    """Local memory per thread, bytes: spilled registers, and arrays with indices that the compiler does not know."""


def resources(cubin: bytes) -> dict[str, Resources]:
    """Of every kernel in a cubin, by its name there. Raises ValueError for what is no 64-bit ELF object."""
    if cubin[:5] != b"\x7fELF\x02":
        raise ValueError("a cubin is a 64-bit ELF object; this is none")
    (table,) = struct.unpack_from("<Q", cubin, 40)
    size, count, names_at = struct.unpack_from("<HHH", cubin, 58)
    # Of each section: name, kind, flags, address, offset, size, link, information.
    headers = [struct.unpack_from("<IIQQQQII", cubin, table + size * k) for k in range(count)]

    def body(k: int) -> bytes:
        return cubin[headers[k][4] : headers[k][4] + headers[k][5]]

    names = [_string(body(names_at), header[0]) for header in headers]
    sizes = {name: header[5] for name, header in zip(names, headers, strict=True)}
    symbols = names.index(".symtab")
    strings = body(headers[symbols][6])
    owners = [_string(strings, entry[0]) for entry in struct.iter_unpack("<IBBHQQ", body(symbols))]
    found = _attributes(body(names.index(".nv.info")), owners)
    reserved = RESERVED if ".nv.shared.reserved.0" in sizes else 0
    return {
        kernel: Resources(registers, max(sizes.get(f".nv.shared.{kernel}", 0) - reserved, 0), found[STACK, kernel])
        for (number, kernel), registers in found.items()
        if number == REGISTERS and f".text.{kernel}" in sizes
    }


def _string(strings: bytes, start: int) -> str:
    return strings[start : strings.index(b"\0", start)].decode()


def _attributes(section: bytes, owners: list[str]) -> dict[tuple[int, str], int]:
    """Attributes that give a number to a symbol, by (attribute, symbol)."""
    found, at = {}, 0
    while at < len(section):
        form, number, size = struct.unpack_from("<BBH", section, at)
        at += 4
        if form == SIZED:
            if number in (REGISTERS, STACK):
                symbol, value = struct.unpack_from("<II", section, at)
                found[number, owners[symbol]] = value
            at += size
    return found
