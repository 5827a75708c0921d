# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Small tokenizers in the published forms, trained on robot sentences: tests/golden/tokenizers/.

    python tools/goldens/train_tokenizer.py FAMILY FOLDER

Needs tokenizers and transformers.
"""

import json
import sys
from pathlib import Path

TASKS = [
    "pick up the red cube and place it in the basket", "open the middle drawer of the cabinet", "push the plate slowly",
    "put the black bowl on top of the stove", "close the bottom drawer", "stack the green block on the yellow block",
]
SMOLLM_SPECIAL = ["<|endoftext|>", "<|im_start|>", "<|im_end|>"]
GEMMA_SPECIAL = ["<pad>", "<eos>", "<bos>", "<unk>"]
LLAMA2 = ["<unk>", "<s>", "</s>"]
INTERNVL = ["<|endoftext|>", "<|im_start|>", "<|im_end|>", "<img>", "</img>", "<IMG_CONTEXT>", "<quad>", "</quad>"]
QWEN2_WORDS = r"(?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\r\n\p{L}\p{N}]?\p{L}+|\p{N}| ?[^\s\p{L}\p{N}]+[\r\n]*|\s*[\r\n]+|\s+(?!\S)|\s+"
QWEN_VL = [f"<|{name}|>" for name in (
    "endoftext", "im_start", "im_end", "object_ref_start", "object_ref_end", "box_start", "box_end", "quad_start", "quad_end",
    "vision_start", "vision_end", "vision_pad", "image_pad", "video_pad")]
EAGLE = [*QWEN_VL, "<IMG_CONTEXT>", "<img>", "</img>"]
LLAMA3 = ["<|begin_of_text|>", "<|end_of_text|>", "<|pad|>", *(f"<|reserved_special_token_{i}|>" for i in (1, 2, 3)),
          "<|start_header_id|>", "<|end_header_id|>", "<|reserved_special_token_4|>", "<|eot_id|>", "<|image_pad|>", "<proprio_pad>",
          *(f"<action_{i}>" for i in range(4))]
LLAMA3_WORDS = (r"(?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\r\n\p{L}\p{N}]?\p{L}+|\p{N}{1,3}| ?[^\s\p{L}\p{N}]+[\r\n]*|\s*[\r\n]+|\s+(?!\S)|\s+")
SYSTEM = "System: A robot listens to a human. It answers with motions."
LLAMA3_TEMPLATE = (
    "{% set loop_messages = messages %}{% for message in loop_messages %}{% set content = message['role'] | capitalize + ': '"
    "+ message['content'] | trim + '<|eot_id|>' %}{{ content }}{% endfor %}{% if add_generation_prompt %}{{ 'Assistant: ' }}{% endif %}")
QWEN_TEMPLATE = (
    "{% for message in messages %}<|im_start|>{{ message.role }}\n{% for part in message.content %}{% if part.type == 'image' %}"
    "<|vision_start|><|image_pad|><|vision_end|>{% else %}{{ part.text }}{% endif %}{% endfor %}<|im_end|>\n{% endfor %}"
    "{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}")


def smolvla(folder, n_merge=40):
    """A byte-level BPE like SmolLM2's (single digits split off), with the processor of SmolVLM."""
    from tokenizers import AddedToken, Tokenizer, decoders, models, pre_tokenizers, trainers
    from transformers import PreTrainedTokenizerFast, SmolVLMImageProcessor, SmolVLMProcessor, SmolVLMVideoProcessor

    fast = Tokenizer(models.BPE())
    steps = [pre_tokenizers.Digits(individual_digits=True), pre_tokenizers.ByteLevel(add_prefix_space=False)]
    fast.pre_tokenizer, fast.decoder = pre_tokenizers.Sequence(steps), decoders.ByteLevel()
    alphabet = pre_tokenizers.ByteLevel.alphabet()
    fast.train_from_iterator([t + "\n" for t in TASKS], trainers.BpeTrainer(
        vocab_size=len(SMOLLM_SPECIAL) + len(alphabet) + n_merge, special_tokens=SMOLLM_SPECIAL, initial_alphabet=alphabet,
        show_progress=False))
    images = {"global_image_token": "<global-img>", "fake_image_token": "<fake_token_around_image>", "image_token": "<image>"}
    fast.add_special_tokens([AddedToken(t, special=True, normalized=False) for t in [*images.values(), "<end_of_utterance>"]])
    words = PreTrainedTokenizerFast(
        tokenizer_object=fast, bos_token="<|im_start|>", eos_token="<end_of_utterance>", unk_token="<|endoftext|>",
        pad_token="<|im_end|>", model_max_length=8192, extra_special_tokens=images)
    SmolVLMProcessor(SmolVLMImageProcessor(), words, SmolVLMVideoProcessor(), image_seq_len=4,
                     chat_template="{{ messages }}").save_pretrained(folder)


def pi(folder, n_piece=150):
    """BPE with byte fallback and a leading <bos>, digits alone, blanks as U+2581: Gemma's form with other merges."""
    from tokenizers import Regex, Tokenizer, models, normalizers, pre_tokenizers, trainers
    from transformers import PreTrainedTokenizerFast

    fast = Tokenizer(models.BPE(unk_token="<unk>"))
    fast.normalizer = normalizers.Replace(" ", "▁")
    fast.pre_tokenizer = pre_tokenizers.Split(Regex(r"\d|\n|▁?[^▁\d\n]+|▁"), "isolated")
    corpus = [f"Task: {t}, State: 0 1 2 3 4 5 6 7 8 9 -1;\nAction: " for t in TASKS]
    fast.train_from_iterator(corpus, trainers.BpeTrainer(
        vocab_size=len(GEMMA_SPECIAL) + n_piece, special_tokens=GEMMA_SPECIAL, show_progress=False))
    spec = json.loads(fast.to_str())
    pieces = sorted(spec["model"]["vocab"], key=spec["model"]["vocab"].get)[len(GEMMA_SPECIAL) :]
    order = GEMMA_SPECIAL + [f"<0x{b:02X}>" for b in range(256)] + pieces
    spec["model"] |= {"vocab": {t: i for i, t in enumerate(order)}, "byte_fallback": True, "fuse_unk": True}
    spec["pre_tokenizer"] = {"type": "Split", "pattern": {"String": " "}, "behavior": "MergedWithPrevious", "invert": False}
    start, text = {"SpecialToken": {"id": "<bos>", "type_id": 0}}, {"Sequence": {"id": "A", "type_id": 0}}
    other = {"Sequence": {"id": "B", "type_id": 1}}
    spec["post_processor"] = {"type": "TemplateProcessing", "single": [start, text], "pair": [start, text, other],
                              "special_tokens": {"<bos>": {"id": "<bos>", "ids": [2], "tokens": ["<bos>"]}}}
    PreTrainedTokenizerFast(tokenizer_object=Tokenizer.from_str(json.dumps(spec)), bos_token="<bos>", eos_token="<eos>",
                            unk_token="<unk>", pad_token="<pad>", model_max_length=8192).save_pretrained(folder)


def qwen(folder, added, frames, n_merge=60, **more):
    """Qwen2's own rules with other merges; the added tokens follow the vocabulary, in the published order.  frames: what stands
    around an instruction."""
    from tokenizers import AddedToken, Tokenizer, models, pre_tokenizers, trainers
    from transformers import PreTrainedTokenizerFast, Qwen2Tokenizer

    published, fast = Qwen2Tokenizer().backend_tokenizer, Tokenizer(models.BPE())
    fast.normalizer, fast.pre_tokenizer, fast.decoder = published.normalizer, published.pre_tokenizer, published.decoder
    corpus = [frame.format(task) for task in TASKS for frame in frames]
    fast.train_from_iterator(corpus, trainers.BpeTrainer(
        vocab_size=256 + n_merge, initial_alphabet=pre_tokenizers.ByteLevel.alphabet(), show_progress=False))
    fast.add_tokens([AddedToken(t, special=True, normalized=False) for t in added])
    words = PreTrainedTokenizerFast(tokenizer_object=fast, pad_token="<|endoftext|>", eos_token="<|im_end|>", padding_side="right",
                                    model_max_length=12288, clean_up_tokenization_spaces=False, **more)
    words.save_pretrained(folder)
    spec, file = json.loads(words.backend_tokenizer.to_str()), folder / "tokenizer_config.json"
    settings = json.loads(file.read_text()) | {"tokenizer_class": "Qwen2Tokenizer", "added_tokens_decoder": {
        str(t["id"]): {k: v for k, v in t.items() if k != "id"} for t in spec["added_tokens"]}}
    settings.pop("backend", None)
    file.write_text(json.dumps(settings, indent=2) + "\n")
    return spec


def evo1(folder):
    """With the three files that the slow class of the authors' layout reads."""
    spec = qwen(folder, INTERNVL, tuple(f"Image-{i}: <\n{{}}\n" for i in (1, 2, 3)))
    write_slow(spec, folder)


def write_slow(spec, folder):
    """What the slow class reads."""
    (folder / "vocab.json").write_text(json.dumps(spec["model"]["vocab"], ensure_ascii=False))
    (folder / "merges.txt").write_text("#version: 0.2\n" + "".join(" ".join(m) + "\n" for m in spec["model"]["merges"]))
    (folder / "added_tokens.json").write_text(json.dumps({t["content"]: t["id"] for t in spec["added_tokens"]}, indent=2))


def gr00t(folder):
    qwen(folder, QWEN_VL, ("<|im_start|>user\n{}<|im_end|>\n",), chat_template=QWEN_TEMPLATE)


def eagle(folder):
    """Of GR00T N1.5 and N1.6, whose code has the slow class's files."""
    spec = qwen(folder, EAGLE, ("<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n<|im_start|>user\n{}<image 1><|im_end|>\n",))
    write_slow(spec, folder)


def bert(folder, n_piece=110):
    """BERT's rules for text without capitals, around another vocabulary."""
    from tokenizers import Tokenizer, models, normalizers, pre_tokenizers, trainers
    from transformers import BertTokenizer

    fast = Tokenizer(models.WordPiece(unk_token="[UNK]"))
    fast.normalizer, fast.pre_tokenizer = normalizers.BertNormalizer(), pre_tokenizers.BertPreTokenizer()
    special = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]"]
    fast.train_from_iterator([t + "!" for t in TASKS], trainers.WordPieceTrainer(
        vocab_size=len(special) + n_piece, special_tokens=special, show_progress=False))
    BertTokenizer(vocab=fast.get_vocab(), model_max_length=512).save_pretrained(folder)


def bart(folder, n_merge=40):
    """A byte-level BPE between <s> and </s>, in the order of facebook/bart-large: <mask> is the last token."""
    from tokenizers import Tokenizer, models, pre_tokenizers, trainers
    from transformers import BartTokenizer

    fast, special = Tokenizer(models.BPE()), ["<s>", "<pad>", "</s>", "<unk>"]
    fast.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    alphabet = pre_tokenizers.ByteLevel.alphabet()
    fast.train_from_iterator(TASKS, trainers.BpeTrainer(
        vocab_size=len(special) + len(alphabet) + n_merge, special_tokens=special, initial_alphabet=alphabet, show_progress=False))
    spec = json.loads(fast.to_str())["model"]
    vocab = spec["vocab"] | {"<mask>": len(spec["vocab"])}
    BartTokenizer(vocab=vocab, merges=[tuple(m) for m in spec["merges"]], model_max_length=1024).save_pretrained(folder)


def bitvla(folder, n_merge=120):
    """Llama 3's rules with other merges; the added tokens follow the vocabulary in the published order, with a few action tokens."""
    from tokenizers import AddedToken, Regex, Tokenizer, decoders, models, pre_tokenizers, processors, trainers

    fast = Tokenizer(models.BPE(ignore_merges=True))
    fast.pre_tokenizer = pre_tokenizers.Sequence([
        pre_tokenizers.Split(Regex(LLAMA3_WORDS), "isolated"), pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False)])
    fast.decoder = decoders.ByteLevel()
    corpus = [f"{SYSTEM}User: What action should the robot take to {task}?Assistant: " for task in TASKS]
    fast.train_from_iterator(corpus, trainers.BpeTrainer(
        vocab_size=256 + n_merge, initial_alphabet=pre_tokenizers.ByteLevel.alphabet(), show_progress=False))
    fast.add_special_tokens([AddedToken(t, special=True, normalized=False) for t in LLAMA3])
    front = "<|begin_of_text|>"
    fast.post_processor = processors.Sequence([processors.ByteLevel(trim_offsets=True), processors.TemplateProcessing(
        f"{front} $A", special_tokens=[(front, fast.token_to_id(front))])])
    folder.mkdir(parents=True, exist_ok=True)
    fast.save(str(folder / "tokenizer.json"))
    spec = json.loads(fast.to_str())
    (folder / "tokenizer_config.json").write_text(json.dumps({
        "added_tokens_decoder": {str(t["id"]): {k: v for k, v in t.items() if k != "id"} for t in spec["added_tokens"]},
        "bos_token": front, "eos_token": "<|end_of_text|>", "pad_token": "<|pad|>", "clean_up_tokenization_spaces": False,
        "chat_template": SYSTEM + "<|eot_id|>" + LLAMA3_TEMPLATE, "model_max_length": 2048,
        "tokenizer_class": "PreTrainedTokenizerFast"}, indent=1) + "\n")


def openvla(folder, n_piece=150):
    """Llama 2's form with other merges: byte fallback, a blank in front of every text, single characters behind all other pieces, of which
    U+2581 is the first, and no line feed.  OpenVLA adds <PAD>."""
    from tokenizers import Regex, Tokenizer, models, normalizers, pre_tokenizers, trainers

    fast = Tokenizer(models.BPE(unk_token="<unk>"))
    fast.normalizer = normalizers.Sequence([normalizers.Prepend("▁"), normalizers.Replace(" ", "▁")])
    fast.pre_tokenizer = pre_tokenizers.Split(Regex(r"\d|\n|▁?[^▁\d\n]+|▁"), "isolated")
    corpus = [f"In: What action should the robot take to {task}?\nOut: 0 1 2 3 4 5 6 7 8 9" for task in TASKS]
    fast.train_from_iterator(corpus, trainers.BpeTrainer(vocab_size=len(LLAMA2) + n_piece, special_tokens=LLAMA2, show_progress=False))
    spec = json.loads(fast.to_str())
    pieces = sorted(set(spec["model"]["vocab"]) - {*LLAMA2, "\n"}, key=lambda piece: (len(piece) == 1, piece != "▁", spec["model"]["vocab"][piece]))
    order = LLAMA2 + [f"<0x{b:02X}>" for b in range(256)] + pieces
    flags = {"single_word": False, "lstrip": False, "rstrip": False, "normalized": False, "special": True}
    spec["added_tokens"] = [{"id": i, "content": token, **flags} for i, token in [*enumerate(LLAMA2), (len(order), "<PAD>")]]
    spec["model"] |= {"vocab": {t: i for i, t in enumerate(order)}, "byte_fallback": True, "fuse_unk": True,
                      "merges": [merge if isinstance(merge, str) else " ".join(merge) for merge in spec["model"]["merges"]]}
    start, text = {"SpecialToken": {"id": "<s>", "type_id": 0}}, {"Sequence": {"id": "A", "type_id": 0}}
    other = [{"SpecialToken": {"id": "<s>", "type_id": 1}}, {"Sequence": {"id": "B", "type_id": 1}}]
    spec |= {"pre_tokenizer": None, "post_processor": {
        "type": "TemplateProcessing", "single": [start, text], "pair": [start, text, *other],
        "special_tokens": {"<s>": {"id": "<s>", "ids": [1], "tokens": ["<s>"]}}}}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "tokenizer.json").write_text(json.dumps(spec, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    (folder / "tokenizer_config.json").write_text(json.dumps({
        "add_bos_token": True, "add_eos_token": False,
        "added_tokens_decoder": {str(t["id"]): {k: v for k, v in t.items() if k != "id"} for t in spec["added_tokens"]},
        "auto_map": {"AutoProcessor": "processing_prismatic.PrismaticProcessor"}, "bos_token": "<s>", "clean_up_tokenization_spaces": False,
        "eos_token": "</s>", "legacy": False, "model_max_length": 2048, "pad_token": "<PAD>", "padding_side": "right",
        "processor_class": "PrismaticProcessor", "sp_model_kwargs": {}, "tokenizer_class": "LlamaTokenizer", "unk_token": "<unk>",
        "use_default_system_prompt": False}, indent=1) + "\n")


def vla_adapter(folder, n_merge=116):
    """Qwen2's rules with other merges, in the form that tokenizers 0.19 reads (a merge is one text), and one added token that is not special."""
    from tokenizers import AddedToken, Regex, Tokenizer, decoders, models, normalizers, pre_tokenizers, trainers

    fast = Tokenizer(models.BPE())
    fast.normalizer, fast.decoder = normalizers.NFC(), decoders.ByteLevel()
    fast.pre_tokenizer = pre_tokenizers.Sequence([
        pre_tokenizers.Split(Regex(QWEN2_WORDS), "isolated"), pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False)])
    system = "system\nYou are Qwen, created by Alibaba Cloud. You are a helpful assistant."
    corpus = [f"{system}\nuser\nWhat action should the robot take to {task}?\nassistant\n" for task in TASKS]
    fast.train_from_iterator(corpus, trainers.BpeTrainer(
        vocab_size=256 + n_merge, initial_alphabet=pre_tokenizers.ByteLevel.alphabet(), show_progress=False))
    fast.add_special_tokens([AddedToken(t, special=True, normalized=False) for t in INTERNVL[:3]])
    fast.add_tokens([AddedToken("<tool_call>", normalized=False)])
    spec = json.loads(fast.to_str())
    spec["model"]["merges"] = [merge if isinstance(merge, str) else " ".join(merge) for merge in spec["model"]["merges"]]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "tokenizer.json").write_text(json.dumps(spec, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    (folder / "tokenizer_config.json").write_text(json.dumps({
        "add_bos_token": False, "add_prefix_space": False,
        "added_tokens_decoder": {str(t["id"]): {k: v for k, v in t.items() if k != "id"} for t in spec["added_tokens"]},
        "additional_special_tokens": INTERNVL[1:3], "auto_map": {"AutoProcessor": "processing_prismatic.PrismaticProcessor"}, "bos_token": None,
        "clean_up_tokenization_spaces": False, "eos_token": "<|endoftext|>", "errors": "replace", "model_max_length": 131072,
        "pad_token": "<|endoftext|>", "processor_class": "PrismaticProcessor", "split_special_tokens": False, "tokenizer_class": "Qwen2Tokenizer",
        "unk_token": None}, indent=1) + "\n")


if __name__ == "__main__":
    {"bart": bart, "bert": bert, "bitvla": bitvla, "eagle": eagle, "smolvla": smolvla, "pi": pi, "evo1": evo1, "gr00t": gr00t,
     "openvla": openvla, "vla_adapter": vla_adapter}[sys.argv[1]](Path(sys.argv[2]))
