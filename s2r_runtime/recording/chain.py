"""The hash chain of a log, block by block, and its signatures.

A block is one chunk with what stands before it since the last chunk (attachments, metadata; at the start of a file its magic and
header too). With s(n) the seal record that closed block n:

    head(0) = 32 zero bytes, or the last head of the file that this one continues
    head(n) = SHA-256( head(n-1) || s(n-1) || records before the chunk || schema, channel and message records of the chunk )

The seal holds head(n); it is the last message of its chunk, and signed where the log has a key. Since each block begins with the
seal before it, the last good signature vouches for every bit that was recorded up to it, signatures included. The seal also holds
the SHA-256 of the file up to its block, so that of all the forms in which the blocks before could lie in the file (zstd can say
the same in many ways) only one is good; the block of the last seal holds nothing else, in the one form that anybody can make anew.
What no chain can show is a tail that is not there: that is what publishing the head is for.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

import msgspec
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from s2r_runtime.recording.channels import Seal

GENESIS = bytes(32)
DOMAIN = b"s2r log chain 2\n"
"""What is signed begins with it, so that no signature made for another purpose counts here."""


def advance(head: bytes, previous_seal: bytes, records: Iterable[bytes | bytearray | memoryview]) -> bytes:
    """The head after a block. previous_seal: the record (not the message) that closed the block before; empty for the first."""
    state = hashlib.sha256(head)
    state.update(previous_seal)
    for record in records:
        state.update(record)
    return state.digest()


def signed(seal: Seal, signer: Ed25519PrivateKey | None) -> Seal:
    """The seal with its signature, or as it is if there is no key."""
    return seal if signer is None else msgspec.structs.replace(seal, signature=signer.sign(_statement(seal)))


def is_signed_by(seal: Seal, key: Ed25519PublicKey) -> bool:
    """Whether the signature is this key's, over exactly this seal."""
    try:
        key.verify(seal.signature, _statement(seal))
    except InvalidSignature:
        return False
    return True


def _statement(seal: Seal) -> bytes:
    return DOMAIN + msgspec.json.encode(msgspec.structs.replace(seal, signature=b""))
