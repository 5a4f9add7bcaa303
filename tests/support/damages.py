import random

KINDS = ("cut", "empty", "page of zeros", "bit", "random bytes")
PAGE = 4096


def damaged(content: bytes, kind: str, seed: int) -> bytes:
    """A content with one damage, which differs from it."""
    generator = random.Random(f"{kind} {seed}")
    while True:
        found = _once(content, kind, generator)
        if found != content:
            return found


def _once(content: bytes, kind: str, generator: random.Random) -> bytes:
    place = generator.randrange(len(content))
    if kind in ("cut", "empty"):
        return content[: place if kind == "cut" else 0]
    if kind == "page of zeros":
        begin = place // PAGE * PAGE
        part = bytes(len(content[begin : begin + PAGE]))
        return content[:begin] + part + content[begin + len(part) :]
    if kind == "bit":
        changed = bytes([content[place] ^ 1 << generator.randrange(8)])
    else:
        changed = generator.randbytes(min(4, len(content) - place))
    return content[:place] + changed + content[place + len(changed) :]
