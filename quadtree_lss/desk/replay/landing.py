# SPDX-License-Identifier: Apache-2.0
"""Areas, keep-outs and targets of a bag: which topics, and what they said by a time."""

from __future__ import annotations

from quadtree_lss.desk.replay.bags import Bag, BagError
from quadtree_lss.desk.replay.records import RawMessage
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.intake import Notice
from quadtree_lss.onboard.messages.landing_inputs import TYPES, LandingWishes


def landing_topics(bag: Bag, *, without: tuple[str, ...] = ()) -> dict[str, str]:
    """``area``, ``keep_out`` or ``target`` by the topic of an open bag that tells it.

    Args:
        without: Names that are not looked for.

    Raises:
        BagError: several topics end alike and none has the plain name.
    """
    found = {}
    for name, kind in TYPES.items():
        plain = f"/landing/{name}"
        there = [
            t.name for t in bag.topics if t.type == kind and t.count and t.name.endswith(plain)
        ]
        if name in without or not there:
            continue
        if plain not in there and len(there) > 1:
            option = name.replace("_", "-")
            msg = f"{bag.path}: several topics of landing/{name}: {', '.join(there)}; say which"
            msg += f" polygon or place holds by --{option}"
            raise BagError(msg)
        found[plain if plain in there else there[0]] = name
    return found


class LandingTopics:
    """Feeds `LandingWishes` from a bag.

    Args:
        wishes: What is fed; names that it holds fixed are not read.
        bag: An open bag.
        start_ns: What was said before is taken at once: these topics are latched.
    """

    def __init__(self, wishes: LandingWishes, bag: Bag, start_ns: int) -> None:
        self.wishes = wishes
        self.names = landing_topics(bag, without=tuple(wishes.fixed))
        self.notices: list[Notice] = []
        if self.names:
            for message in bag.messages(list(self.names), 0, start_ns):
                self.take(bag, message)

    def take(self, bag: Bag, message: RawMessage) -> bool:
        """True if the message was of these topics."""
        name = self.names.get(message.topic)
        if name is None:
            return False
        try:
            msg = bag.decode(message.raw, TYPES[name])
        except MessageError as error:
            self.wishes.refuse(name, error)
            self._tell(name, error)
            return True
        try:
            self.wishes.take(name, msg)
        except MessageError as error:
            self._tell(name, error)
        return True

    def _tell(self, name: str, error: MessageError) -> None:
        self.notices.append(Notice(f"{name}_{error.reason}", f"landing/{name}: {error}"))
