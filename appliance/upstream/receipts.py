"""Messages received on one connection, until they are acknowledged: in order, and QoS 2 once.

QoS 2 messages (section 4.3.3) hold their packet identifier until the sender's PUBREL.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from appliance.mqtt.packets import Puback
from appliance.mqtt.reason import ProtocolError, ReasonCode

#: First byte, packet identifier and reason code of a PUBACK or PUBREC to be sent.
Answer = tuple[int, int, int]


@dataclass(slots=True)
class _Receipt:
    """A message that waits for its acknowledgement; `code` is None until `acknowledge`."""

    qos: int
    code: int | None = None


class Receipts:
    """The messages of QoS 1 and 2 that a connection has received and not finished.

    `maximum` is our Receive Maximum, None in 3.1.1, which has none.
    """

    def __init__(self, maximum: int | None) -> None:
        self._maximum = maximum
        self._is_v5 = maximum is not None
        self._receipts: dict[int, _Receipt] = {}
        self._order: deque[int] = deque()  # of arrival
        self._unreleased: set[int] = set()

    def __len__(self) -> int:
        return len(self._receipts) + len(self._unreleased)

    def expects(self, packet_id: int, qos: int, dup: bool) -> bool:
        """Note a message of QoS 1 or 2; False if it was received on this connection before.

        Raises:
            ProtocolError: its identifier is in use, or there are more messages than we allow.
        """
        if packet_id in self._unreleased:
            if qos != 2:
                raise _in_use(packet_id)
            return False
        receipt = self._receipts.get(packet_id)
        if receipt is not None:
            # 3.1.1 may send a message again on the same connection; v5 [MQTT-4.4.0-1] may not.
            if receipt.qos != qos or (qos == 1 and (self._is_v5 or not dup)):
                raise _in_use(packet_id)
            return False
        if self._maximum is not None and len(self) >= self._maximum:  # [MQTT-3.3.4-9]
            raise ProtocolError(
                ReasonCode.RECEIVE_MAXIMUM_EXCEEDED,
                f"more than {self._maximum} messages that are not acknowledged",
            )
        self._receipts[packet_id] = _Receipt(qos)
        self._order.append(packet_id)
        return True

    def is_unreleased(self, packet_id: int) -> bool:
        """Whether PUBREC was sent: it is sent again for each duplicate (v5 [MQTT-4.3.3-10])."""
        return packet_id in self._unreleased

    def acknowledge(self, packet_id: int, code: int) -> list[Answer]:
        """Acknowledge a message; what may be sent now, in the order of arrival.

        Raises:
            ValueError: no message with this identifier waits for it, or PUBACK has no such code.
        """
        receipt = self._receipts.get(packet_id)
        if receipt is None or receipt.code is not None:
            raise ValueError(f"no message with the packet identifier {packet_id} waits")
        if code not in Puback.REASONS:
            raise ValueError(f"PUBACK has no reason code 0x{code:02x}")
        receipt.code = code
        answers: list[Answer] = []
        while self._order:  # [MQTT-4.6.0-2] [MQTT-4.6.0-3]
            packet_id = self._order[0]
            receipt = self._receipts[packet_id]
            if receipt.code is None:
                break
            self._order.popleft()
            del self._receipts[packet_id]
            answers.append((0x40 if receipt.qos == 1 else 0x50, packet_id, receipt.code))
            # A refused one is over: 5.0 section 4.3.3. 3.1.1 cannot refuse.
            if receipt.qos == 2 and not (self._is_v5 and receipt.code >= 0x80):
                self._unreleased.add(packet_id)
        return answers

    def release(self, packet_id: int) -> ReasonCode:
        """PUBREL has come; the reason code of PUBCOMP.

        Raises:
            ProtocolError: PUBREC was not sent yet.
        """
        if packet_id in self._receipts:
            raise ProtocolError(
                ReasonCode.PROTOCOL_ERROR, f"a PUBREL for {packet_id} before its PUBREC"
            )
        if packet_id not in self._unreleased:  # such as one of an earlier connection
            return ReasonCode.PACKET_IDENTIFIER_NOT_FOUND
        self._unreleased.discard(packet_id)
        return ReasonCode.SUCCESS


def _in_use(packet_id: int) -> ProtocolError:
    return ProtocolError(
        ReasonCode.PROTOCOL_ERROR,
        f"a PUBLISH with the packet identifier {packet_id}, which is in use",
    )
