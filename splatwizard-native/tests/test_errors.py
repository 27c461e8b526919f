"""Messages stay readable whatever a stranger's file put into them."""

import pytest

from splatwizard_native import ForeseenError, shortened
from splatwizard_native.errors import MAX_MESSAGE, MAX_WORD


def test_a_key_of_many_characters_is_told_by_its_ends():
    message = str(ForeseenError(f"unknown key 'a{'b' * 60_000}c' in x.toml: did you mean 'd'?"))
    assert message.startswith("unknown key 'abbb")
    assert "bc' in x.toml: did you mean 'd'?" in message
    assert "(60,004 characters)" in message
    assert len(message) < MAX_WORD


def test_a_path_is_never_cut():
    path = "/" + "/".join(["folder" * 40] * 4)
    assert str(ForeseenError(f"{path}: not there")) == f"{path}: not there"


@pytest.mark.parametrize("message", ["key " * 60_000, "\n".join(["x" * 900] * 1000)])
def test_a_message_of_many_words_is_bounded(message):
    assert len(shortened(message)) < MAX_MESSAGE
    assert shortened(message)[:1000] == message[:1000]
