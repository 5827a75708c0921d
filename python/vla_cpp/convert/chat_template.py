# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Renders a chat template as transformers does (utils/chat_template_utils.py), to check the prompt that it produces."""

from __future__ import annotations

import os
from typing import List, Optional, Tuple

from .errors import Code, refuse
from .files import read_json, read_text

MAX_TEMPLATE = 1 << 16


def find(folder: str) -> Tuple[str, Optional[str]]:
    """The file that holds the folder's chat template, and the template or None."""
    name = "chat_template.jinja"
    if os.path.exists(os.path.join(folder, name)):
        return name, read_text(os.path.join(folder, name))
    for name in ("chat_template.json", "tokenizer_config.json"):
        path = os.path.join(folder, name)
        text = read_json(path).get("chat_template") if os.path.exists(path) else None
        if isinstance(text, str):
            return name + ": chat_template", text
    return name, None


def user_turn(template: str, where: str, n_view: int, text: str, add_generation_prompt: bool) -> str:
    """The prompt of one user turn with `n_view` images followed by a text; if the template fails, a description of the error."""
    try:
        from jinja2 import Undefined
        from jinja2.exceptions import TemplateError
        from jinja2.sandbox import ImmutableSandboxedEnvironment
    except ImportError as error:
        raise refuse(where, "the package that renders chat templates", str(error), "pip install jinja2", Code.UNSUPPORTED) from None

    class Unstated(Undefined):
        """An undefined variable: a template may test it, but fails when it prints it."""

        __str__ = Undefined._fail_with_undefined_error

    environment = ImmutableSandboxedEnvironment(trim_blocks=True, lstrip_blocks=True, undefined=Unstated, extensions=["jinja2.ext.loopcontrols"])
    del environment.globals["range"]  # an untrusted template could loop endlessly over it
    content: List[dict] = [{"type": "image"} for _ in range(n_view)]
    message = {"role": "user", "content": [*content, {"type": "text", "text": text}]}
    try:
        if len(template) > MAX_TEMPLATE:
            raise TemplateError("longer than {} characters".format(MAX_TEMPLATE))
        return environment.from_string(template).render(
            messages=[message], tools=None, documents=None, add_generation_prompt=add_generation_prompt
        )
    except (TemplateError, ArithmeticError, LookupError, TypeError, ValueError, RecursionError) as error:
        return "a template that fails: {}".format(error)
