# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Reads the values of a pickle without executing anything in it.

A pickle is a program for a stack machine. Python's own machine imports and calls everything that the program names. This machine builds
lists, dictionaries and tuples, and turns every imported name and every call into an inert record, except the few calls that stand for
data, for which the caller provides `calls`. Its steps and bytes are limited, and no step takes more memory than its own bytes.
"""

from __future__ import annotations

import io
import pickletools
from typing import Callable, Dict, Iterator, List, NamedTuple, Tuple

from .errors import refuse

# The pickle of a policy with a thousand tensors has about 100 KB and 50,000 steps; with an optimizer's state a few times more.
MAX_BYTES, MAX_STEPS = 16 << 20, 2_000_000
# Opcodes that push their argument (protocols 2 to 5; the text opcodes of older protocols are not supported).
ARGUMENTS = set(
    """
    BININT BININT1 BININT2 LONG1 LONG4 BINFLOAT BINUNICODE SHORT_BINUNICODE BINUNICODE8
    BINBYTES SHORT_BINBYTES BINBYTES8 BYTEARRAY8 BINSTRING SHORT_BINSTRING
    """.split()
)
CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
EMPTY = {"EMPTY_LIST": list, "EMPTY_DICT": dict, "EMPTY_TUPLE": tuple, "EMPTY_SET": set}
TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
PUTS, GETS = ("BINPUT", "LONG_BINPUT"), ("BINGET", "LONG_BINGET")
OTHERS = set(
    """
    PROTO FRAME STOP MARK TUPLE LIST DICT POP POP_MARK DUP MEMOIZE APPEND APPENDS SETITEM SETITEMS ADDITEMS FROZENSET GLOBAL
    STACK_GLOBAL REDUCE NEWOBJ NEWOBJ_EX BUILD BINPERSID
    """.split()
)
KNOWN = OTHERS.union(ARGUMENTS, CONSTANTS, EMPTY, TUPLES, PUTS, GETS)
KEYS = (str, int, float, bytes, type(None))  # types of keys that are kept; entries with other keys are dropped
MAX_KEY = 1 << 60  # integers from 2^61 - 1 on have the same hashes as smaller ones; a dictionary of such keys takes quadratic time


class Global(NamedTuple):
    """A name that the pickle imports, as "module name"."""

    name: str


class Inert:
    """Stands for the result of an import or a call, of which only the name is known."""

    def __init__(self, name: str) -> None:
        self.name = name


def describe(value) -> str:
    """A value's name or type for an error message, never its content, which may be nested endlessly."""
    return value.name.replace(" ", ".")[:100] if isinstance(value, (Global, Inert)) else type(value).__name__


def _is_key(value) -> bool:
    return isinstance(value, KEYS) and not (isinstance(value, int) and abs(value) >= MAX_KEY)


Calls = Dict[str, Callable[[tuple], object]]  # "module name" -> function that returns the value of a call with these arguments
MARK = object()


class _Machine:
    def __init__(self, calls: Calls, persistent: Callable[[object], object]) -> None:
        self.calls, self.persistent = calls, persistent
        self.stack: List[object] = []
        self.memo: Dict[int, object] = {}

    def pop(self, kind=object):
        value = self.stack.pop()
        if value is MARK or not isinstance(value, kind):
            raise ValueError("a value where another kind of value must be")
        return value

    def top(self, kind=object):
        value = self.pop(kind)
        self.stack.append(value)
        return value

    def since_mark(self) -> list:
        items = []
        while self.stack[-1] is not MARK:
            items.append(self.stack.pop())
        self.stack.pop()
        return items[::-1]

    def step(self, name: str, argument) -> None:
        stack = self.stack
        if name in ARGUMENTS:
            stack.append(argument)
        elif name in CONSTANTS:
            stack.append(CONSTANTS[name])
        elif name in EMPTY:
            stack.append(EMPTY[name]())
        elif name == "MARK":
            stack.append(MARK)
        elif name in TUPLES:
            items = [self.pop() for _ in range(TUPLES[name])]
            stack.append(tuple(items[::-1]))
        elif name in ("TUPLE", "LIST"):
            stack.append((tuple if name == "TUPLE" else list)(self.since_mark()))
        elif name in PUTS:
            self.memo[argument] = self.top()
        elif name == "MEMOIZE":
            self.memo[len(self.memo)] = self.top()
        elif name in GETS:
            stack.append(self.memo[argument])
        elif name == "POP":
            stack.pop()
        elif name == "POP_MARK":
            self.since_mark()
        elif name == "DUP":
            stack.append(self.top())
        else:
            self.build(name, argument)

    def build(self, name: str, argument) -> None:
        stack = self.stack
        if name in ("APPEND", "APPENDS"):
            items = [self.pop()] if name == "APPEND" else self.since_mark()
            self.extend(items)
        elif name in ("SETITEM", "SETITEMS", "DICT"):
            items = [self.pop(), self.pop()][::-1] if name == "SETITEM" else self.since_mark()
            if name == "DICT":
                stack.append({})
            self.update(items)
        elif name in ("ADDITEMS", "FROZENSET"):
            self.since_mark()  # drops members of sets
            if name == "FROZENSET":
                stack.append(Inert("frozenset"))
        elif name == "GLOBAL":
            stack.append(Global(argument))
        elif name == "STACK_GLOBAL":
            attribute, module = self.pop(str), self.pop(str)
            stack.append(Global(module + " " + attribute))
        elif name in ("REDUCE", "NEWOBJ"):
            arguments, target = self.pop(tuple), self.pop()
            stack.append(self.call(target, arguments))
        elif name == "NEWOBJ_EX":
            self.pop(dict), self.pop(tuple)
            stack.append(Inert(describe(self.pop())))
        elif name == "BUILD":
            self.pop()  # drops attributes of an object
            self.top()
        elif name == "BINPERSID":
            stack.append(self.persistent(self.pop()))

    def extend(self, items: list) -> None:
        if isinstance(self.top(), list):
            self.top().extend(items)
        elif not isinstance(self.top(), Inert):
            raise ValueError("items for what is no list")

    def update(self, items: list) -> None:
        if len(items) % 2:
            raise ValueError("a key without a value")
        if isinstance(self.top(), dict):
            self.top().update((k, v) for k, v in zip(items[::2], items[1::2]) if _is_key(k))
        elif not isinstance(self.top(), Inert):
            raise ValueError("items for what is no dictionary")

    def call(self, target, arguments: tuple):
        if not isinstance(target, Global):
            return Inert(describe(target))
        make = self.calls.get(target.name)
        return Inert(target.name) if make is None else make(arguments)


def _steps(data: bytes) -> Iterator[Tuple[str, object]]:
    """Names of opcodes with their arguments. An argument is read only for an opcode that this machine supports."""
    file = io.BytesIO(data)
    for _ in range(MAX_STEPS):
        code = file.read(1)
        opcode = pickletools.code2op.get(code.decode("latin-1"))
        if opcode is None or opcode.name not in KNOWN:
            raise ValueError("the opcode {}".format(opcode.name if opcode else repr(code)) if code else "no end")
        yield opcode.name, None if opcode.arg is None else opcode.arg.reader(file)
    raise ValueError("more than {} steps".format(MAX_STEPS))


def read_pickle(data: bytes, where: str, calls: Calls, persistent: Callable[[object], object]):
    """The value in the pickle. `persistent`: maps a persistent id to its value. Errors: bad_bundle."""
    machine = _Machine(calls, persistent)
    try:
        for name, argument in _steps(data):
            if name == "STOP":
                break
            machine.step(name, argument)
        return machine.pop()
    except (ValueError, IndexError, KeyError) as error:
        # A damaged argument is a ValueError of pickletools; the other exceptions come from an empty stack or an unknown memo.
        reason = str(error) if isinstance(error, ValueError) else "a stack or a memo that lacks a value"
        raise refuse(where, "a well-formed pickle", reason[:200], "the file is truncated or damaged: download or save it again")


def ordered_dict(arguments: tuple) -> dict:
    """The value of a call of collections.OrderedDict, without arguments or with pairs."""
    if not arguments:
        return {}
    pairs = arguments[0] if isinstance(arguments[0], list) else [()]
    if len(arguments) != 1 or not all(isinstance(p, (list, tuple)) and len(p) == 2 for p in pairs):
        raise ValueError("an OrderedDict of something else than pairs")
    return {key: value for key, value in pairs if _is_key(key)}
