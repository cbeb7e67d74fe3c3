"""Damaged versions of a file, each a function of the file and a number."""

import random
import re
from collections.abc import Callable

_TOKEN = re.compile(rb"[0-9A-Za-z_.+-]+")
_LARGEST = 2 * 2**20

#: What breaks parsers: numbers at the edges of types, what only Python reads as a number, impossible dates,
#: unclosed brackets, other encodings, paths that lead out.
_HOSTILE = (
    *(b"0", b"-1", b"-0", b"1", b"65535", b"65536", b"2147483647", b"2147483648", b"4294967296"),
    *(b"9223372036854775807", b"9223372036854775808", b"-9223372036854775808", b"1000000000000"),
    *(b"nan", b"NaN", b"inf", b"-inf", b"1e400", b"-1e308", b"1e308", b"4.9e-324", b"1e-320", b"0x10"),
    *(b"1_000", b"1,5", b"5.", b".", b"+", b"--1", b"1e", b"9" * 400, b"9" * 5000, b"0." + b"0" * 5000),
    *("\u0663\u0664".encode(), "\u00b2".encode(), "\U0001f4a9".encode(), b"\xff\xfe", b"\xef\xbb\xbf"),
    *(b"\0", b"\r", b"\n", b"\t", b"\x1a", b"\x85", b"\xc2\xa0", b",", b";", b"=", b"#", b'"', b"'"),
    *(b"{", b"}", b"[", b"]", b"{" * 3000, b"[" * 3000, b"}" * 3000, b"{}" * 3000, b"," * 20000),
    *(b"true", b"none", b"null", b"../../../etc/passwd", b"/etc/passwd", b"~", b"/dev/zero", b"**/*", b"/*"),
    *(b"2021-02-30", b"24:61:61", b"0001-01-01T00:00:00+14:00", b"9999-12-31T23:59:59-14:00", b"23:59:60"),
    *(b"2262-04-12", b"1677-09-21", b"1970-01-01T00:00:00Z", b"12:00", b"Feb", b" " * 5000, b"%s%n{0}"),
)  # fmt: skip


def mutated(seed: bytes, name: str, number: int) -> bytes:
    """Return damaged version ``number`` of a file.

    Parameters
    ----------
    seed
        The file.
    name
        What is damaged; two names give two series of damages.
    number
        Any; the same number gives the same bytes.

    Examples
    --------
    >>> mutated(b"lines = 3", "envi", 7) == mutated(b"lines = 3", "envi", 7)
    True
    """
    rng = random.Random(f"{name}:{number}")
    data = bytearray(seed)
    for _ in range(min(8, 1 + int(rng.expovariate(0.8)))):
        rng.choice(_DAMAGES)(data, rng)
        del data[_LARGEST:]
    return bytes(data)


def _span(data: bytearray, rng: random.Random) -> slice:
    start = rng.randrange(len(data) + 1)
    return slice(start, start + int(rng.paretovariate(0.6)))


def _token(data: bytearray, rng: random.Random) -> slice:
    found = _TOKEN.search(data, rng.randrange(len(data) + 1)) or _TOKEN.search(data)
    return slice(0, 0) if found is None else slice(*found.span())


def _line(data: bytearray, rng: random.Random) -> slice:
    place = rng.randrange(len(data) + 1)
    end = data.find(b"\n", place)
    return slice(data.rfind(b"\n", 0, place) + 1, len(data) if end < 0 else end + 1)


def _flip(data: bytearray, rng: random.Random) -> None:
    if data:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _early_flip(data: bytearray, rng: random.Random) -> None:
    # Damage the first bytes, where binary formats hold their sizes
    if data:
        data[rng.randrange(min(len(data), 600))] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))


def _burst(data: bytearray, rng: random.Random) -> None:
    span = _span(data, rng)
    data[span] = rng.randbytes(len(data[span]))


def _integer(data: bytearray, rng: random.Random) -> None:
    # Write an integer or a float at the edge of its type over some bytes
    place = rng.randrange(min(len(data), rng.choice((600, 2**31))) + 1)
    value = rng.choice((0, 1, 2**7, 2**15 - 1, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1))
    raw = value.to_bytes(8, "little")
    raw = rng.choice((raw[:2], raw[:4], raw, b"\0\0\x80\x7f", b"\0\0\xc0\x7f", b"\0" * 6 + b"\xf0\x7f"))
    data[place : place + len(raw)] = raw


def _truncate(data: bytearray, rng: random.Random) -> None:
    del data[rng.randrange(len(data) + 1) :]


def _append(data: bytearray, rng: random.Random) -> None:
    data += rng.randbytes(int(rng.paretovariate(0.5)) % 5000)


def _delete(data: bytearray, rng: random.Random) -> None:
    del data[_span(data, rng)]


def _repeat(data: bytearray, rng: random.Random) -> None:
    span = rng.choice((_span, _token, _line))(data, rng)
    piece = data[span][:5000]
    data[span.stop : span.stop] = piece * min(rng.choice((1, 2, 30, 3000)), 1 + 200_000 // (len(piece) + 1))


def _zeros(data: bytearray, rng: random.Random) -> None:
    span = _span(data, rng)
    data[span] = bytes(len(data[span]))


def _replace(data: bytearray, rng: random.Random) -> None:
    data[rng.choice((_token, _span))(data, rng)] = rng.choice(_HOSTILE)


def _insert(data: bytearray, rng: random.Random) -> None:
    place = _span(data, rng).start
    data[place:place] = rng.choice(_HOSTILE)


def _exchange(data: bytearray, rng: random.Random) -> None:
    # Put one token, or line, in the place of another
    pick = rng.choice((_token, _line))
    piece = bytes(data[pick(data, rng)])
    data[pick(data, rng)] = piece


def _remove(data: bytearray, rng: random.Random) -> None:
    del data[rng.choice((_token, _line))(data, rng)]


def _scale(data: bytearray, rng: random.Random) -> None:
    # Change a number to another one of its kind
    span = _token(data, rng)
    try:
        value = float(data[span])
    except ValueError:
        return
    made = value * rng.choice((-1.0, 0.1, 10.0, 1e6, 1e-6)) + rng.choice((0.0, 1.0, -1.0))
    data[span] = (b"%d" % int(made)) if value.is_integer() and abs(made) < 1e30 else repr(made).encode()


_DAMAGES: tuple[Callable[[bytearray, random.Random], None], ...] = (
    *(_flip, _early_flip, _burst, _integer, _truncate, _append, _delete, _repeat, _zeros),
    *(_replace, _replace, _replace, _insert, _exchange, _exchange, _remove, _scale, _scale),
)  # fmt: skip
