"""What a compiled library exports and needs, for ``wheels.py``: ELF, PE and Mach-O."""

from __future__ import annotations

import hashlib
import io
import re
import struct

MACHINES = {
    "linux": {"x86_64": "EM_X86_64", "arm64": "EM_AARCH64"},
    "windows": {"x86_64": 0x8664, "arm64": 0xAA64},
    "macos": {"x86_64": 0x01000007, "arm64": 0x0100000C},
}


def check(content: bytes, system: str, machine: str, tag: str) -> None:
    """Raises ValueError unless a library is for this machine, exports ms_* only, and needs no more than the
    system and its version in the ``tag`` of the wheel provide."""
    expected = MACHINES[system][machine]
    if system == "linux":
        _check_elf(content, expected, tag)
    elif system == "windows":
        _check_pe(content, expected)
    else:
        _check_macho(content, expected, tag)


def _check_exports(names: list[str]) -> None:
    _require("ms_best_variant" in names, "does not export ms_best_variant")
    foreign = [name for name in names if not name.startswith("ms_")]
    _require(not foreign, f"exports {', '.join(foreign)}")


def _require(condition: object, message: str) -> None:
    if not condition:
        raise ValueError(message)


def _check_elf(content: bytes, machine: str, tag: str) -> None:
    # Which libraries and symbol versions it may need is auditwheel's part, except for musl.
    from elftools.elf.elffile import ELFFile

    file = ELFFile(io.BytesIO(content))
    _require(file["e_machine"] == machine, f"is for {file['e_machine']}")
    _require(file.get_section_by_name(".symtab") is None, "is not stripped")
    symbols = file.get_section_by_name(".dynsym").iter_symbols()
    _check_exports([s.name for s in symbols if s.name and s["st_shndx"] != "SHN_UNDEF"])
    if tag.startswith("musllinux"):
        needed = [d.needed for d in file.get_section_by_name(".dynamic").iter_tags("DT_NEEDED")]
        _require(needed == ["libc.so"], f"needs {', '.join(needed)}")
    stack = [s["p_flags"] for s in file.iter_segments() if s["p_type"] == "PT_GNU_STACK"]
    _require(stack and not stack[0] & 1, "wants an executable stack")


def _check_pe(content: bytes, machine: int) -> None:
    import pefile

    file = pefile.PE(data=content)
    _require(file.FILE_HEADER.Machine == machine, f"is for machine {file.FILE_HEADER.Machine:#x}")
    _check_exports([symbol.name.decode() for symbol in file.DIRECTORY_ENTRY_EXPORT.symbols])
    # The universal C runtime is part of Windows 10.
    imports = [entry.dll.decode() for entry in file.DIRECTORY_ENTRY_IMPORT]
    foreign = [dll for dll in imports if not re.fullmatch(r"(?i)kernel32\.dll|api-ms-win-crt-.*\.dll", dll)]
    _require(not foreign, f"needs {', '.join(foreign)}")


# Mach-O, after <mach-o/loader.h> and <kern/cs_blobs.h>

_LOAD_DYLIB = {0xC, 0x80000018, 0x8000001F, 0x80000023}
_DYLD_INFO = {0x22, 0x80000022}
_EXPORTS_TRIE = 0x80000033
_CODE_SIGNATURE = 0x1D
_VERSION_MIN, _BUILD_VERSION = 0x24, 0x32
_OF_THE_LINKER = {"__mh_dylib_header", "___dso_handle"}


def _check_macho(content: bytes, machine: int, tag: str) -> None:
    magic, cpu = struct.unpack_from("<II", content)
    _require(magic == 0xFEEDFACF, "is no 64-bit Mach-O file")
    _require(cpu == machine, f"is for processor {cpu:#x}")
    libraries, exports, version, signature = [], None, None, None
    (count,) = struct.unpack_from("<I", content, 16)
    at = 32
    for _ in range(count):
        command, size = struct.unpack_from("<II", content, at)
        if command in _LOAD_DYLIB:
            (name,) = struct.unpack_from("<I", content, at + 8)
            libraries.append(content[at + name : at + size].split(b"\0")[0].decode())
        elif command in _DYLD_INFO:
            exports = exports or struct.unpack_from("<II", content, at + 40)
        elif command == _EXPORTS_TRIE:
            exports = struct.unpack_from("<II", content, at + 8)
        elif command == _CODE_SIGNATURE:
            signature = struct.unpack_from("<II", content, at + 8)
        elif command in (_VERSION_MIN, _BUILD_VERSION):
            (number,) = struct.unpack_from("<I", content, at + (8 if command == _VERSION_MIN else 12))
            version = f"{number >> 16}_{number >> 8 & 255}"
        at += size
    _require(libraries == ["/usr/lib/libSystem.B.dylib"], f"needs {', '.join(libraries)}")
    _require(version and tag.startswith(f"macosx_{version}_"), f"needs macOS {version}")
    _require(exports, "exports nothing")
    assert exports is not None
    trie = content[exports[0] : exports[0] + exports[1]]
    names = set(_trie_names(trie)) - _OF_THE_LINKER
    _check_exports(sorted(name.removeprefix("_") for name in names))
    # Macs with Intel processors load unsigned libraries.
    if signature:
        _check_signature(content, *signature)
    else:
        _require(machine != MACHINES["macos"]["arm64"], "is not signed, which arm64 requires")


def _trie_names(trie: bytes, at: int = 0, prefix: str = "") -> list[str]:
    def number(at: int) -> tuple[int, int]:  # ULEB128
        value = shift = 0
        while True:
            byte = trie[at]
            at += 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value, at

    length, at = number(at)
    names = [prefix] if length else []
    at += length
    children = trie[at]
    at += 1
    for _ in range(children):
        end = trie.index(0, at)
        child, after = number(end + 1)
        names += _trie_names(trie, child, prefix + trie[at:end].decode())
        at = after
    return names


def _check_signature(content: bytes, offset: int, size: int) -> None:
    """An ad-hoc signature: hashes of all pages, without a certificate."""
    blob = content[offset : offset + size]
    magic, _, count = struct.unpack_from(">III", blob)
    _require(magic == 0xFADE0CC0, "has an unknown signature")
    places = [struct.unpack_from(">II", blob, 12 + 8 * k) for k in range(count)]
    directory = next((blob[place:] for kind, place in places if kind == 0), b"")
    _require(directory[:4] == b"\xfa\xde\x0c\x02", "has a signature without code directory")
    flags, hashes, _, _, pages, limit = struct.unpack_from(">IIIIII", directory, 12)
    length, kind, _, page_bits = struct.unpack_from("BBBB", directory, 36)
    _require(flags & 2, "is signed, but not ad hoc")
    _require(kind == 2 and length == 32, "is signed with another hash than SHA-256")
    _require(limit == offset, "is signed in part only")
    page = 1 << page_bits
    _require(pages == -(-limit // page), "has a signature with another number of pages")
    for k in range(pages):
        expected = directory[hashes + length * k : hashes + length * (k + 1)]
        found = hashlib.sha256(content[k * page : min((k + 1) * page, limit)]).digest()
        _require(found == expected, f"has a wrong signature of page {k}")
