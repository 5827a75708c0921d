# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The prompt that a chat template renders from images and an instruction, and the positions of the image tokens."""

from __future__ import annotations

import re
from typing import List, NamedTuple, Sequence

from ...ascii_bpe import Encoder, check_undivided, special_ids
from ...bundle import Key
from ...errors import Problems
from ...tokenizer import TokenizerPlan
from .sizes import WHERE, Sizes

START, END = "<|im_start|>", "<|im_end|>"
# Tokens of an instruction. The reference never truncates; the bundle needs a limit, which is far above any instruction.
N_INSTRUCTION = 512


class Template(NamedTuple):
    """The text around an instruction and its views. `open` may contain {i}, the view's number from 1."""

    before: str
    after: str
    open: str
    token: str
    close: str
    behind: bool = False  # the views come after the instruction

    @property
    def special(self) -> List[str]:
        """The special tokens in the template, in order of first occurrence."""
        found = re.findall(r"<[^< ]+>", self.before + self.open + self.token + self.close + self.after)
        return list(dict.fromkeys(found))


class Prompt(NamedTuple):
    view_starts: List[int]  # index of each view's first image token; counted from the end if the views come after the instruction
    behind: bool
    n_token: int  # the longest prompt

    def keys(self) -> List[Key]:
        return [
            Key("policy.view_starts" + ("_from_end" if self.behind else ""), "u32[]", self.view_starts),
            Key("observation.max_text_tokens", "u32", self.n_token),
        ]


# LeRobot replaces an empty instruction by this text (policies/groot/processor_groot.py); the authors' code does not.
LEROBOT_EMPTY = {"op": "if_empty", "text": "Perform the task."}


FORMALIZE = [{"op": "lower"}, {"op": "drop_punctuation"}]


def text_ops(template: Template, clean: List[dict], prompt: Prompt, s: Sizes) -> List[dict]:
    """The text ops. `clean`: ops on the instruction before it is inserted into the prompt."""
    view = {"open": template.open, "token": template.token, "repeat": s.n_view_token, "close": template.close}
    place = {"place": "back"} if template.behind else {}
    return [
        *clean,
        {"op": "views", "count": s.max_views, **view, **place},
        {"op": "template", "text": template.before + "{instruction}" + template.after},
        {"op": "tokenize", "max_tokens": prompt.n_token, "truncate": "right"},
    ]


def count_tokens(text: str, special: Sequence[str], encoder: Encoder) -> int:
    parts = re.split("({})".format("|".join(map(re.escape, special))), text)
    return sum(1 if part in special else len(encoder.ids(part)) for part in parts)


def read_prompt(template: Template, tokenizer: TokenizerPlan, hint: str, s: Sizes, problems: Problems) -> Prompt:
    special = template.special
    special_ids(tokenizer.keys, special, hint, problems)
    words = re.split("|".join(map(re.escape, special)), template.before + template.open + template.after)
    check_undivided(tokenizer.keys, special, [word for word in words if word], problems)
    encoder = Encoder(tokenizer.keys)

    def count(text: str) -> int:
        return count_tokens(text, special, encoder)

    opens = [template.open.replace("{i}", str(i + 1)) for i in range(s.max_views)]
    view, starts = template.token * s.n_view_token + template.close, []
    for i in range(s.max_views):
        if template.behind:
            starts.append(count(view + "".join(part + view for part in opens[i + 1 :]) + template.after))
        else:
            starts.append(count(template.before + "".join(part + view for part in opens[:i]) + opens[i]))
    end = count(template.before) + starts[0] if template.behind else starts[-1] + s.n_view_token
    if end + 4 > s.n_context:
        expected = "room for {} views of {} tokens".format(s.max_views, s.n_view_token)
        problems.add(WHERE + ": text_config: max_position_embeddings", expected, "{} tokens".format(s.n_context))
    return Prompt(starts, template.behind, min(end + 2 + N_INSTRUCTION, s.n_context))
