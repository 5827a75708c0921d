# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""A chat template, rendered as transformers renders it (utils/chat_template_utils.py), to see which prompt it makes."""

from __future__ import annotations

import os
from typing import List, Optional, Tuple

from .errors import Code, refuse
from .files import read_json, read_text

MAX_TEMPLATE = 1 << 16


def find(folder: str) -> Tuple[str, Optional[str]]:
    """Where the folder states its template, and the template."""
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
    """The prompt of one user's turn with so many images and then a text, or how the template fails."""
    try:
        from jinja2 import Undefined
        from jinja2.exceptions import TemplateError
        from jinja2.sandbox import ImmutableSandboxedEnvironment
    except ImportError as error:
        raise refuse(where, "the package that renders chat templates", str(error), "pip install jinja2", Code.UNSUPPORTED) from None

    class Unstated(Undefined):
        """A variable that is not given here may be asked for, and not printed."""

        __str__ = Undefined._fail_with_undefined_error

    environment = ImmutableSandboxedEnvironment(trim_blocks=True, lstrip_blocks=True, undefined=Unstated, extensions=["jinja2.ext.loopcontrols"])
    del environment.globals["range"]  # a template of someone else's is no place for long loops
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
