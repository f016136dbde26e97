"""Messages of JSON-RPC 2.0, as Moonraker takes and answers them (dialects/moonraker.md 1.3)."""

import asyncio
from typing import Any, Final

import msgspec
from msgspec import UNSET, Raw

from toolpost.dialects.moonraker.connections import Connection
from toolpost.dialects.moonraker.errors import INVALID_REQUEST, PARSE_ERROR, RpcError, as_rpc_error
from toolpost.dialects.moonraker.rpc import Methods, Order

MAX_BATCH: Final = 5000
"""Calls in one message."""

MAX_BATCH_ANSWER: Final = 16 * 2**20
"""Bytes of answers to one message after which the rest of it is refused."""

_NULL: Final = b"null"
_TURN: Final = 50


class _Envelope(msgspec.Struct):
    jsonrpc: Any = UNSET
    method: Any = UNSET
    params: Any = UNSET
    id: Raw = Raw()


class Call(msgspec.Struct):
    """One call of a message; with an error it is only answered."""

    id: bytes
    method: str = ""
    params: object = None
    error: RpcError | None = None

    @property
    def answered(self) -> bool:
        """Whether a success has an answer too."""
        return self.id != _NULL


class Message(msgspec.Struct):
    """The calls of one message.

    Attributes:
        calls: what to do; without any there is nothing to say.
        batch: whether they came as an array.
        order: when to do it: a batch with an urgent call is urgent.
        size: its length, for bounds.
    """

    calls: list[Call]
    batch: bool
    order: Order
    size: int


_ENVELOPE: Final = msgspec.json.Decoder(_Envelope)
_ARRAY: Final = msgspec.json.Decoder(list[Raw])
_ENCODER: Final = msgspec.json.Encoder()


def decode_message(data: str | bytes | bytearray, methods: Methods) -> Message | None:
    """Return what a message asks for, or None if it is neither an object nor an array.

    Args:
        data: the message.
        methods: says which of them are urgent.
    """
    try:
        text = data if isinstance(data, str) else data.decode("utf-8")
        first = text.lstrip()[:1]
        if first == "[":
            calls = _decode_batch(_ARRAY.decode(text))
        elif first == "{":
            calls = _decode_call(text)
        else:
            msgspec.json.decode(text)
            return None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        calls = [_refused(_NULL, PARSE_ERROR, "Parse error")]
        return Message(calls, batch=False, order=Order.IN_TURN, size=len(data))
    orders = {methods.order(call.method) for call in calls}
    order = next((order for order in (Order.URGENT, Order.BESIDE) if order in orders), Order.IN_TURN)
    return Message(calls, batch=first == "[", order=order, size=len(data))


async def answer_message(message: Message, methods: Methods, connection: Connection) -> bytes | None:
    """Do what a message asks for, one call after the other; return the answer, or None if there is none."""
    if not message.batch:
        return await _answer_call(message.calls[0], methods, connection) if message.calls else None
    answers = []
    size = 0
    for number, call in enumerate(message.calls):
        if number % _TURN == 0:
            await asyncio.sleep(0)
        if size > MAX_BATCH_ANSWER and call.error is None:
            call.error = RpcError(413, "the answers to this batch are too long; send fewer calls at a time")
        answer = await _answer_call(call, methods, connection)
        if answer is not None:
            answers.append(answer)
            size += len(answer)
    return b"[" + b",".join(answers) + b"]" if answers else None


def refuse_message(message: Message, error: RpcError) -> bytes | None:
    """Return the answer to a message of which nothing is done."""
    answers = [_encode_error(call.error or error, call.id) for call in message.calls]
    if not message.batch:
        return answers[0] if answers else None
    return b"[" + b",".join(answers) + b"]" if answers else None


def _decode_batch(items: list[Raw]) -> list[Call]:
    if len(items) > MAX_BATCH:
        return [_refused(_NULL, INVALID_REQUEST, f"Invalid Request: more than {MAX_BATCH} calls")]
    calls = []
    for item in items:
        # JSON-RPC 2.0, section 6: an item that is no object is answered for itself.
        if bytes(memoryview(item)[:1]) == b"{":
            calls += _decode_call(item)
        else:
            calls.append(_refused(_NULL, INVALID_REQUEST, "Invalid Request"))
    return calls


def _decode_call(text: str | Raw) -> list[Call]:
    envelope = _ENVELOPE.decode(text)
    identity = bytes(envelope.id).strip() or _NULL
    if envelope.method is UNSET:
        # Taken for a response, of which there are none that are waited for.
        return []
    if envelope.jsonrpc != "2.0" or not isinstance(envelope.method, str):
        return [_refused(identity, INVALID_REQUEST, "Invalid Request")]
    return [Call(identity, envelope.method, None if envelope.params is UNSET else envelope.params)]


def _refused(identity: bytes, code: int, message: str) -> Call:
    return Call(identity, error=RpcError(code, message))


async def _answer_call(call: Call, methods: Methods, connection: Connection) -> bytes | None:
    if call.error is not None:
        return _encode_error(call.error, call.id)
    try:
        result = await methods.dispatch(call.method, call.params, connection)
        if not call.answered:
            return None
        return b'{"jsonrpc":"2.0","result":' + _ENCODER.encode(result) + b',"id":' + call.id + b"}"
    except Exception as error:  # noqa: BLE001  # routed by as_rpc_error
        return _encode_error(as_rpc_error(error, call.method), call.id)


def _encode_error(error: RpcError, identity: bytes) -> bytes:
    encoded = _ENCODER.encode({"code": error.rpc_code, "message": error.message})
    return b'{"jsonrpc":"2.0","error":' + encoded + b',"id":' + identity + b"}"
