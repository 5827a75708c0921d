# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Fields of tokenizer.json and tokenizer_config.json changed one by one: the converter follows transformers, or refuses.

    python tools/tokenizer_fields.py [--only NAME] [--all]    exit code 1 where ids differ from those of transformers

Starts from the tokenizers of tests/golden/tokenizers.  Of each changed pair of files AutoTokenizer's ids of some texts are compared with
those of a tokenizer that is built from the keys of a bundle alone (tests/support/tokenizer_from_keys.py).  Where transformers fails,
anything but a crash is right.  Needs transformers and tokenizers.  --all prints what was done with every change.
"""

import argparse
import copy
import json
import logging
import sys
import tempfile
import warnings
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "python"), str(ROOT / "tests/support")]
from tokenizer_from_keys import ids_of, tokenizer_of  # noqa: E402

FOLDER = ROOT / "tests/golden/tokenizers"
FILES = ("tokenizer.json", "tokenizer_config.json")
MODEL = "config.json"  # a model's own config in the folder, whose type may name the tokenizer's class
# With these changes in force all others are made again.
BASES = {
    "as it is": (),
    "no class": ((FILES[1], ("tokenizer_class",), ()),),
    "no class, a model's folder": ((FILES[1], ("tokenizer_class",), ()), (MODEL, ("model_type",), ("OWN",))),
    "no post_processor": ((FILES[0], ("post_processor",), ()),),
    "no class and post_processor, a model's folder": (
        (FILES[1], ("tokenizer_class",), ()), (FILES[0], ("post_processor",), ()), (MODEL, ("model_type",), ("OWN",))),
    "another model's folder": ((MODEL, ("model_type",), ("OTHER",)),),
}
MODEL_TYPES = {"bart": "bart", "bert": "bert", "pi": "gemma", "smolvla": "gpt2", "evo1": "qwen2", "eagle": "qwen3", "gr00t": "qwen3_vl", "bitvla": "bart",
               "openvla": "llama", "vla_adapter": "qwen2"}
TEXTS = ("pick it up", "Pick  the red\nblock", "  it's 12 caf\u00e9 ", "pu\u0301sh [SEP] <s> <|im_end|> <eos> go", "", "up.Down<image>x", "\u4e2d\u6587 go")
CLASSES = ("PreTrainedTokenizerFast", "TokenizersBackend", "GPT2Tokenizer", "Qwen2Tokenizer", "BartTokenizer", "BertTokenizer",
           "GemmaTokenizer", "LlamaTokenizer", "LlamaTokenizerFast", "T5Tokenizer", "CLIPTokenizer", "Qwen2TokenizerFast", "RobertaTokenizer")
# Fields that configs have, whether or not the case's own does.
MORE = {
    "add_prefix_space": (True, False, None), "add_bos_token": (True, False, None), "add_eos_token": (True, False, None),
    "do_lower_case": (True, False), "strip_accents": (True, False), "tokenize_chinese_chars": (True, False), "legacy": (True, False),
    "split_special_tokens": (True,), "trim_offsets": (True, False), "use_fast": (True, False), "errors": ("strict",),
    "clean_up_tokenization_spaces": (True, False), "tokenizer_class": CLASSES, "truncation_side": ("left",), "padding_side": ("left",),
    "bos_token": ("<s>", "[NEW]", None), "eos_token": ("[NEW]", None), "unk_token": ("[NEW]", None), "pad_token": ("[NEW]", None),
    "cls_token": ("[NEW]", None), "sep_token": ("[NEW]", None), "mask_token": ("[NEW]", None), "additional_special_tokens": (["[NEW]"], []),
    "extra_special_tokens": ({"a_token": "[NEW]"}, ["[NEW]"]), "model_max_length": (4,), "from_slow": (True,), "add_dummy_prefix_space": (True,),
    "spaces_between_special_tokens": (True,), "never_split": (["up"],), "do_basic_tokenize": (False,), "sp_model_kwargs": ({},),
    "model_input_names": (["input_ids"],), "normalizer": (None,), "special_tokens_map_file": ("x",), "auto_map": (None,),
}


def others(value):
    """Values of the same kind, and none."""
    if isinstance(value, bool):
        return [not value, None]
    if isinstance(value, int):
        return [value + 1, max(0, value - 1), value + 40]
    if isinstance(value, str):
        return [value + "x", value.upper(), ""]
    if isinstance(value, list):
        return [[], value[1:], value + value[:1], value[::-1], None]
    return [None] if isinstance(value, dict) else [True, False, "up", {}]


def changes(value, path=()):
    """(path, new value) of everything within, vocabulary and merges as wholes; a path alone: the field is missing."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield (*path, key), ()
            for new in others(inner):
                yield (*path, key), (new,)
            if key not in ("vocab", "merges", "pair", "decoder"):
                yield from changes(inner, (*path, key))
    elif isinstance(value, list):
        for i, inner in enumerate(value[:3]):
            yield from changes(inner, (*path, i))


def changed(files, which, path, new):
    files = copy.deepcopy(files)
    inner = files[which]
    for key in path[:-1]:
        inner = inner[key]
    if new:
        inner[path[-1]] = new[0]
    else:
        inner.pop(path[-1], None)
    return files


def all_changes(files):
    for which in FILES:
        for path, new in changes(files[which]):
            yield which, path, new
    for key, values in MORE.items():
        for value in values:
            yield FILES[1], (key,), (value,)


def reference(folder, texts):
    from transformers import AutoTokenizer

    tokenizer = AutoTokenizer.from_pretrained(folder)
    return [tokenizer(text)["input_ids"] for text in texts]


def converted(folder, texts):
    """None where the converter refuses."""
    from vla_cpp.convert.errors import ConvertError, Problems
    from vla_cpp.convert.tokenizer import read_tokenizer

    problems = Problems(str(folder))
    try:
        plan = read_tokenizer(str(folder), 4096, problems, [])
        problems.raise_any()
    except ConvertError:
        return None
    keys = {key.name: key.value for key in plan.keys}
    tokenizer = tokenizer_of(keys)
    return [ids_of(tokenizer, keys, text) for text in texts]


def base_of(name, base):
    files = {file: json.loads((FOLDER / name / file).read_text()) for file in FILES}
    for which, path, new in BASES[base]:
        files.setdefault(which, {})
        files = changed(files, which, path, {("OWN",): (MODEL_TYPES[name],), ("OTHER",): ("bert" if name == "bart" else "bart",)}.get(new, new))
    return files


def compare(name, base, tell):
    files = base_of(name, base)
    texts = [*TEXTS, "a".join(token["content"] for token in files[FILES[0]]["added_tokens"])]
    told, wrong, seen = dict.fromkeys(("followed", "refused", "unreadable to transformers"), 0), [], 0
    for which, path, new in [(FILES[0], ("version",), ("1.0",)), *all_changes(files)]:
        what = f"{which}: {'.'.join(map(str, path))} " + (f"= {json.dumps(new[0], ensure_ascii=False)[:60]}" if new else "missing")
        with tempfile.TemporaryDirectory() as folder:
            for file, value in changed(files, which, path, new).items():
                (Path(folder) / file).write_text(json.dumps(value))
            try:
                expected = reference(folder, texts)
            except BaseException as error:  # noqa: BLE001 - whatever stops it, a panic of Rust included
                expected = None
                if isinstance(error, KeyboardInterrupt):
                    raise
            found = converted(folder, texts)
        seen += 1
        if expected is None:
            kind = "unreadable to transformers"
        else:
            kind = "refused" if found is None else "followed" if found == expected else "WRONG"
        if kind == "WRONG":
            at = next(i for i in range(len(texts)) if found[i] != expected[i])
            wrong.append(f"{what}\n        {texts[at]!r}: transformers {expected[at][:14]}, bundle {found[at][:14]}")
        else:
            told[kind] += 1
        if tell:
            print(f"    {kind}: {what}")
    print(f"{name}, {base}: {seen} changes: " + ", ".join(f"{n} {kind}" for kind, n in told.items()) + f", {len(wrong)} wrong", flush=True)
    for line in wrong:
        print("    " + line)
    return not wrong


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="NAME")
    parser.add_argument("--base", action="append", choices=BASES)
    parser.add_argument("--all", action="store_true")
    args = parser.parse_args()
    warnings.filterwarnings("ignore")
    logging.disable(logging.CRITICAL)
    names = [args.only] if args.only else sorted(path.name for path in FOLDER.iterdir())
    sys.exit(not all([compare(name, base, args.all) for base in (args.base or BASES) for name in names]))


if __name__ == "__main__":
    main()
