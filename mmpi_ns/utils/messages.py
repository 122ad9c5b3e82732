"""Words for messages to the user."""

from __future__ import annotations


def brief(error: BaseException) -> str:
    """What an error says, cut after its first sentence: it goes in brackets into a sentence of ours."""
    return str(error).strip().split("\n")[0].split(". ")[0].rstrip(" .")
