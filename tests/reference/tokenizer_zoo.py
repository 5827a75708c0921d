# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Small tokenizers that between them use every setting the runtime knows, and strings that are hard to split.

Both are deterministic.  The sentences are the authors' own.
"""

import random
import sys
import unicodedata

from tokenizers import AddedToken, Regex, Tokenizer, models, normalizers, pre_tokenizers, processors, trainers

SENTENCES = """
pick up the red cube and place it in the bowl
Pick up the red cube, then place it in the bowl!
open the top drawer 10 cm, close it after 3.5 s, don't drop the cup; it's hot, they'll say we've failed
I'd move the robot's arm 45° left, you're right; I'm sure she's seen 1,234,567 cubes
stack block_7 onto block-12 (x=0.25, y=-1e-3) <now>
heb den roten Würfel auf und lege ihn in die Schüssel, größer als 20 Äpfel
prends le cube rouge et pose-le dans le bol, s'il te plaît; c'est l'été à l'œuvre
recoge el cubo rojo y ponlo en el cuenco, ¿mañana o el año próximo?
pegue o cubo vermelho e coloque-o na tigela, não é difícil
raccogli il cubo rosso e mettilo nella ciotola perché è già tardi
возьми красный кубик и положи его в миску, ещё 5 раз
взяти червоний кубик і покласти в миску, їжак і ґанок
podnieś czerwoną kostkę i włóż ją do miski, żółć gęślą jaźń
zvedni červenou kostku a polož ji do misky, příliš žluťoučký kůň
kırmızı küpü al ve kaseye koy, İstanbul ılık ğüşçö
σήκωσε τον κόκκινο κύβο και βάλε τον στο μπολ, ὦ ἄνδρες Ἀθηναῖοι
拿起红色的方块放进碗里，然后关上第三个抽屉。
赤い立方体を拾ってボウルに入れてください。コップは３つです。
빨간 큐브를 집어서 그릇에 넣으세요, 그리고 서랍을 닫아요
ยกลูกบาศก์สีแดงแล้ววางลงในชามเบอร์ ๑๒๓
लाल घन उठाओ और कटोरे में रखो, संख्या १२३ है
লাল ঘনকটি তুলে বাটিতে রাখুন, ৪৫ বার
சிவப்பு கனசதுரத்தை எடுத்து கிண்ணத்தில் வை
التقط المكعب الأحمر وضعه في الوعاء رقم ١٢٣
הרם את הקובייה האדומה ושים אותה בקערה
مکعب قرمز را بردار و در کاسه بگذار، شماره ۴۵۶
nhặt khối lập phương màu đỏ và đặt vào bát, đừng đánh rơi
angkat kubus merah dan letakkan di mangkuk
chukua mchemraba mwekundu na uweke kwenye bakuli
ቀዩን ኩብ አንስተህ በሳህኑ ውስጥ አስቀምጥ ፲፪
აიღე წითელი კუბი და ჩადე თასში
վերցրու կարմիր խորանարդը և դիր ամանի մեջ
ხმა ⵣ ᚠᛇᚻ ꦲ ᐃᓄᒃ
⅓ cup, ½ turn, ², Ⅷ, ①②, 〇, x₁ ← x₀ + Δt·v(xₜ, t) ∀ t ∈ [0, 1]
emoji 🤖🦾 👩🏽‍🔬 🏳️‍🌈 👨‍👩‍👧‍👦 🇫🇷🇩🇪 ✋🏿 1️⃣ ☕️
``code()`` { "key": [1, 2, null] } http://a.b/c?d=e&f=%20#g \\path\\to\\file $HOME ~/x
""".strip().split("\n")
SENTENCES.append("tabs\tand\t\ttabs  double  blanks   triple   end   \n\nnew lines\r\n\r\nand more\n")

SPECIALS = ["<|endoftext|>", "<|im_start|>", "<|im_end|>", "<image>", "<fake_token_around_image>", "<global-img>"]


def train(pre_tokenizer, vocab_size: int, specials: list, **model_options) -> Tokenizer:
    tokenizer = Tokenizer(models.BPE(**model_options))
    tokenizer.pre_tokenizer = pre_tokenizer
    trainer = trainers.BpeTrainer(
        vocab_size=vocab_size, special_tokens=specials, initial_alphabet=sorted(pre_tokenizers.ByteLevel.alphabet()), show_progress=False
    )
    tokenizer.train_from_iterator(SENTENCES * 3, trainer)
    return tokenizer


def smol() -> Tokenizer:
    """The shape of SmolLM2's: single digits, no blank in front, special tokens inside and after the vocabulary."""
    steps = [pre_tokenizers.Digits(individual_digits=True), pre_tokenizers.ByteLevel(add_prefix_space=False)]
    tokenizer = train(pre_tokenizers.Sequence(steps), 700, SPECIALS[:3])
    tokenizer.add_special_tokens([AddedToken(text, normalized=False, special=True) for text in SPECIALS[3:]])
    return tokenizer


def awkward() -> Tokenizer:
    """Added tokens with every option, overlapping each other; digits in runs; a blank in front of every piece."""
    steps = [pre_tokenizers.Digits(individual_digits=False), pre_tokenizers.ByteLevel(add_prefix_space=True)]
    tokenizer = train(pre_tokenizers.Sequence(steps), 500, [])
    tokenizer.add_tokens(
        [
            AddedToken("<l>", lstrip=True, normalized=False),
            AddedToken("<r>", rstrip=True, normalized=False),
            AddedToken("<lr>", lstrip=True, rstrip=True, normalized=True),
            AddedToken("cube", single_word=True, normalized=False),
            AddedToken("cube bowl", normalized=False),
            AddedToken("bow", single_word=True, normalized=True),
            AddedToken("ab", normalized=True),
            AddedToken("abc", normalized=True),
            AddedToken("bcd", normalized=True),
            AddedToken(" <sp> ", normalized=False),
            AddedToken("\n<nl>", rstrip=True, normalized=False),
            AddedToken("größer", single_word=True, lstrip=True, normalized=True),
            AddedToken("🤖", rstrip=True, normalized=False),
            AddedToken("<<", normalized=False),
            AddedToken("<", single_word=True, rstrip=True, normalized=True),
        ]
    )
    return tokenizer


def whole() -> Tokenizer:
    """Whole words before merges, no digits step; some words can be reached in that way only."""
    tokenizer = train(pre_tokenizers.ByteLevel(add_prefix_space=False), 600, SPECIALS[:1], ignore_merges=True)
    return with_words(tokenizer, ["Ġrobot's", "Ġgripper", "12", "Ġ7", "ĠвÐ", "ĊĊĊ", "Ġ<|im_end|>", "!!!!"], ignore_merges=True)


def with_words(tokenizer: Tokenizer, words: list[str], **model_options) -> Tokenizer:
    import json

    spec = json.loads(tokenizer.to_str())
    for word in words:
        spec["model"]["vocab"].setdefault(word, len(spec["model"]["vocab"]))
    spec["model"].update(model_options)
    return Tokenizer.from_str(json.dumps(spec))


def tangled() -> Tokenizer:
    """Random merges over few symbols: many ways to the same token at different ranks, one split for the whole text."""
    rng = random.Random(7)
    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    vocab = {symbol: i for i, symbol in enumerate(alphabet)}
    pool, merges = list("abcĠ1"), []
    while len(merges) < 600:
        left, right = rng.choice(pool), rng.choice(pool)
        if len(left + right) > 9 or (left, right) in merges:
            continue
        merges.append((left, right))
        if left + right not in vocab:
            vocab[left + right] = len(vocab)
            pool.append(left + right)
    tokenizer = Tokenizer(models.BPE(vocab=vocab, merges=merges))
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False)
    return tokenizer


QWEN2 = r"(?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\r\n\p{L}\p{N}]?\p{L}+|\p{N}| ?[^\s\p{L}\p{N}]+[\r\n]*|\s*[\r\n]+|\s+(?!\S)|\s+"
LLAMA3 = QWEN2.replace(r"|\p{N}|", r"|\p{N}{1,3}|")


def qwen() -> Tokenizer:
    """The shape of Qwen2's: composed characters, words with one mark in front, special tokens after the vocabulary."""
    steps = [pre_tokenizers.Split(Regex(QWEN2), "isolated"), pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False)]
    tokenizer = train(pre_tokenizers.Sequence(steps), 700, [])
    tokenizer.normalizer = normalizers.NFC()
    specials = ["<|endoftext|>", "<|im_start|>", "<|im_end|>", "<img>", "</img>", "<IMG_CONTEXT>"]
    tokenizer.add_special_tokens([AddedToken(text, normalized=False, special=True) for text in specials])
    return tokenizer


def llama() -> Tokenizer:
    """The shape of Llama 3's: up to three digits are a word, words that are tokens skip the merges, and a token stands in front."""
    steps = [pre_tokenizers.Split(Regex(LLAMA3), "isolated"), pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False)]
    tokenizer = train(pre_tokenizers.Sequence(steps), 700, [])
    tokenizer.model.ignore_merges = True
    specials = ["<|begin_of_text|>", "<|end_of_text|>", "<|eot_id|>", "<|image_pad|>", "<proprio_pad>"]
    tokenizer.add_special_tokens([AddedToken(text, normalized=False, special=True) for text in specials])
    template = processors.TemplateProcessing("<|begin_of_text|> $A", special_tokens=[(specials[0], tokenizer.token_to_id(specials[0]))])
    tokenizer.post_processor = processors.Sequence([processors.ByteLevel(trim_offsets=True), template])
    return tokenizer


def qwen_awkward() -> Tokenizer:
    """Every step one after another, and added tokens that change when they are composed, or are part of what does."""
    steps = [
        pre_tokenizers.Digits(individual_digits=False),
        pre_tokenizers.Split(Regex(QWEN2), "isolated"),
        pre_tokenizers.ByteLevel(add_prefix_space=True, use_regex=True),
    ]
    tokenizer = train(pre_tokenizers.Sequence(steps), 500, [])
    tokenizer.normalizer = normalizers.NFC()
    options = [dict(lstrip=True), dict(rstrip=True), dict(single_word=True), {}]
    texts = ["e\u0301", "\u00e9t", "\u0301", "A\u030a\u0327", "\u212b", "\uac00", "\u1100\u1161\u11a8", "\u0f71\u0f72", "<\u0338", "cu", "\u2126 "]
    tokenizer.add_tokens([AddedToken(text, normalized=i % 2 == 0, **options[i % 4]) for i, text in enumerate(texts)])
    return tokenizer


BYTES = [f"<0x{byte:02X}>" for byte in range(256)]


def byte_fallback(vocab: dict, merges: list, added: list[AddedToken], front: list[str]) -> Tokenizer:
    """A tokenizer.json as the Gemma models publish it, around any vocabulary."""
    import json

    spec = json.loads(Tokenizer(models.BPE(vocab=vocab, merges=merges, unk_token="<unk>", fuse_unk=True, byte_fallback=True)).to_str())
    spec["normalizer"] = {"type": "Replace", "pattern": {"String": " "}, "content": "\u2581"}
    spec["pre_tokenizer"] = {"type": "Split", "pattern": {"String": " "}, "behavior": "MergedWithPrevious", "invert": False}
    parts = [{"SpecialToken": {"id": token, "type_id": 0}} for token in front] + [{"Sequence": {"id": "A", "type_id": 0}}]
    special = {token: {"id": token, "ids": [vocab[token]], "tokens": [token]} for token in front}
    pair = [{"Sequence": {"id": "A", "type_id": 0}}, {"Sequence": {"id": "B", "type_id": 1}}]
    spec["post_processor"] = {"type": "TemplateProcessing", "single": parts, "pair": pair, "special_tokens": special}
    tokenizer = Tokenizer.from_str(json.dumps(spec))
    for token in added:  # one by one, so that ids follow the order
        (tokenizer.add_special_tokens if token.special else tokenizer.add_tokens)([token])
    return tokenizer


def sentence_pieces(vocab_size: int, sentences: list[str]) -> tuple[dict, list]:
    """Vocabulary and merges of a trained BPE whose words carry their blank in front, with Gemma's special tokens and bytes."""
    import json

    tokenizer = Tokenizer(models.BPE())
    tokenizer.normalizer = normalizers.Replace(" ", "\u2581")
    tokenizer.pre_tokenizer = pre_tokenizers.Split(Regex("\\d|\n+|\u2581?[^\u2581\\d\n]+|\u2581+"), "isolated")
    tokenizer.train_from_iterator(sentences, trainers.BpeTrainer(vocab_size=vocab_size, show_progress=False))
    model = json.loads(tokenizer.to_str())["model"]
    pieces = ["<pad>", "<eos>", "<bos>", "<unk>", "<mask>", *BYTES, *sorted(model["vocab"], key=model["vocab"].get)]
    return {piece: i for i, piece in enumerate(pieces)}, [tuple(merge) for merge in model["merges"]]


def gemma() -> Tokenizer:
    """The shape of Gemma's: runs of blanks and newlines are tokens by themselves, places and segments follow the vocabulary."""
    vocab, merges = sentence_pieces(900, SENTENCES * 3)
    for run in ["\n", "\n\n", "\n\n\n", "\u2581\u2581", "\u2581\u2581\u2581", "\t", "<table>"]:
        vocab.setdefault(run, len(vocab))
    runs = ["\n\n", "\n\n\n", "\u2581\u2581", "\u2581\u2581\u2581", "<table>"]
    added = [AddedToken(text, normalized=False, special=True) for text in ["<pad>", "<eos>", "<bos>", "<unk>", "<mask>"]]
    added += [AddedToken(text, normalized=False) for text in runs]
    added += [AddedToken(f"<loc{i:04}>", normalized=False, special=True) for i in range(5)]
    return byte_fallback(vocab, merges, added, ["<bos>"])


def gemma_awkward() -> Tokenizer:
    """Added tokens with every option beside a vocabulary of few characters, so that most text falls back to bytes."""
    vocab, merges = sentence_pieces(60, ["pick up the red cube and place it in the bowl"] * 3)
    options = [dict(lstrip=True), dict(rstrip=True), dict(lstrip=True, rstrip=True), dict(single_word=True), {}]
    texts = ["<l>", "<r>", "<lr>", "cube", "cube bowl", "a b", "ab", "\u2581 \u2581", "  ", "\n<nl>", "größer", "🤖", "<<", "blue bowl", " the "]
    added = [AddedToken("<unk>", normalized=False, special=True)]
    added += [AddedToken(text, normalized=i % 2 == 0, **options[i % 5]) for i, text in enumerate(texts)]
    return byte_fallback(vocab, merges, added, [])


def gemma_tangled() -> Tokenizer:
    """Random merges of characters, blanks and byte tokens: many ways to the same token at different ranks."""
    rng = random.Random(8)
    pool = [*"abc1\u2581\n", "<0xC3>", "<0xA9>", "<0xF0>", "<0x9F>"]
    vocab = {piece: i for i, piece in enumerate(["<unk>", "<bos>", *BYTES, *pool[:6]])}
    merges = []
    while len(merges) < 600:
        left, right = rng.choice(pool), rng.choice(pool)
        if len(left + right) > 14 or (left, right) in merges:
            continue
        merges.append((left, right))
        if left + right not in vocab:
            vocab[left + right] = len(vocab)
            pool.append(left + right)
    return byte_fallback(vocab, merges, [AddedToken("<bos>", normalized=False, special=True)], ["<bos>", "<unk>"])


def wordpiece(vocab_size: int, sentences: list[str]) -> Tokenizer:
    """What BERT publishes, with another vocabulary."""
    specials = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]"]
    tokenizer = Tokenizer(models.WordPiece(unk_token="[UNK]"))
    tokenizer.normalizer, tokenizer.pre_tokenizer = normalizers.BertNormalizer(), pre_tokenizers.BertPreTokenizer()
    trainer = trainers.WordPieceTrainer(vocab_size=vocab_size, special_tokens=specials, show_progress=False)
    tokenizer.train_from_iterator(sentences, trainer)
    front, behind = ((text, tokenizer.token_to_id(text)) for text in ("[CLS]", "[SEP]"))
    tokenizer.post_processor = processors.TemplateProcessing("[CLS] $A [SEP]", special_tokens=[front, behind])
    return tokenizer


def bert() -> Tokenizer:
    """The shape of BERT's: letters of the sentences alone are tokens, so that many words are unknown."""
    return wordpiece(600, SENTENCES * 3)


def bert_awkward() -> Tokenizer:
    """Every letter on its own is a token, within a word too; added tokens that change when they are normalized."""
    letters = [c for c in map(chr, [*range(0x180), *range(0x370, 0x460)]) if c.isprintable() and not c.isspace()]
    tokenizer = with_words(wordpiece(300, SENTENCES * 3), [*letters, *("##" + c for c in letters), "##", "###a", "ab", "##bc"])
    options = [dict(lstrip=True), dict(rstrip=True), {}]
    texts = ["<l>", "Caf\u00e9 x", "[NEW]", "e\u0301", "\u4e2d", " A", "CUBE", "bow", "\u0130", "#", "<<", "\u200b", "\ufb01"]
    tokenizer.add_tokens([AddedToken(text, normalized=i % 2 == 0, **options[i % 3]) for i, text in enumerate(texts)])
    return tokenizer


def bart() -> Tokenizer:
    """The shape of BART's: every text stands between two tokens, and the last token takes the blanks in front of it."""
    specials = ["<s>", "<pad>", "</s>", "<unk>"]
    tokenizer = train(pre_tokenizers.ByteLevel(add_prefix_space=False), 700, specials)
    tokenizer.add_special_tokens([AddedToken("<mask>", lstrip=True, special=True)])
    tokenizer.post_processor = processors.RobertaProcessing(sep=("</s>", 2), cls=("<s>", 0), add_prefix_space=False)
    return tokenizer


ZOO = {
    "smol": smol,
    "awkward": awkward,
    "whole": whole,
    "tangled": tangled,
    "qwen": qwen,
    "qwen_awkward": qwen_awkward,
    "llama": llama,
    "gemma": gemma,
    "gemma_awkward": gemma_awkward,
    "gemma_tangled": gemma_tangled,
    "bert": bert,
    "bert_awkward": bert_awkward,
    "bart": bart,
}

SPACES = [c for c in map(chr, range(0x110000)) if c.isspace()] + list("\u200b\u200c\u200d\u2060\ufeff\u180e\u00ad")
DIGITS = [c for c in map(chr, range(0x110000)) if unicodedata.category(c) in ("Nd", "Nl", "No")]
MARKS = [c for c in map(chr, range(0x110000)) if unicodedata.category(c).startswith("M")]
NORMAL = [c for c in map(chr, range(0x110000)) if not 0xD800 <= ord(c) <= 0xDFFF and unicodedata.normalize("NFD", c) != c and not 0xAC00 <= ord(c) <= 0xD7A3]
JAMO = [chr(c) for c in (*range(0x1100, 0x1113), *range(0x1161, 0x1176), *range(0x11A7, 0x11C3), 0xAC00, 0xAC01, 0xD788, 0xD7A3)]
CONTRACTIONS = ["'S", "'Re", "'lL", "'\u017f", "'\u017ft", "'D1", "'s", "'t", "'re", "'ve", "'m", "'ll", "'d", "'S", "'LL", "'", "''s", "’s", "'sx", "'r", "'l"]
EMOJI = ["🤖", "👩🏽‍🔬", "🏳️‍🌈", "🇫🇷", "1️⃣", "☕️", "\u200d", "\ufe0f", "🏽"]
PLANES = [(0, 0x7F), (0x80, 0x24F), (0x250, 0x7FF), (0x800, 0xD7FF), (0xE000, 0xFFFF), (0x10000, 0x1FFFF), (0x20000, 0x10FFFF)]


def any_char(rng: random.Random) -> str:
    low, high = rng.choice(PLANES)
    return chr(rng.randint(low, high))


def fuzz_piece(rng: random.Random, added: list[str]) -> str:
    kind = rng.randrange(17)
    if kind == 0:
        return any_char(rng)
    if kind == 1:
        return rng.choice(SPACES) * rng.choice([1, 1, 2, 3])
    if kind == 2:
        return "".join(rng.choice(DIGITS) for _ in range(rng.randint(1, 4)))
    if kind == 3:
        return rng.choice("aeiouszAEé가水") + "".join(rng.choice(MARKS) for _ in range(rng.randint(1, 3)))
    if kind == 4:
        return rng.choice(CONTRACTIONS)
    if kind == 5:
        return rng.choice(EMOJI)
    if kind == 6 and added:
        return rng.choice(added)
    if kind == 7 and added:  # a token that is not quite there
        token = rng.choice(added)
        return token[: rng.randint(1, len(token))] + rng.choice(["", "x", " "])
    if kind == 8:
        return rng.choice("abc1 <>\n") * rng.choice([1, 2, 5, 17, 60])
    if kind == 9:
        return "".join(rng.choice("abc1 ") for _ in range(rng.randint(1, 30)))
    if kind == 10:  # what composes, taken apart and mixed with marks
        composed = rng.choice(NORMAL) + rng.choice(["", rng.choice(MARKS)])
        return unicodedata.normalize("NFD", composed) + rng.choice(["", rng.choice(MARKS)])
    if kind == 11:
        return "".join(rng.choice(JAMO) for _ in range(rng.randint(1, 5)))
    if kind == 12:
        return "".join(rng.choice(" \t\r\n.!a1\u00a0'") for _ in range(rng.randint(1, 8)))
    sentence = rng.choice(SENTENCES)
    start = rng.randrange(len(sentence))
    return sentence[start : start + rng.randint(1, 25)]


def fuzz_string(rng: random.Random, added: list[str]) -> str:
    if rng.random() < 0.02:
        return "".join(any_char(rng) for _ in range(rng.randint(1, 200)))
    if rng.random() < 0.002:
        return fuzz_piece(rng, added) * rng.randint(50, 500)
    joint = rng.choice(["", "", " ", "\n"])
    return joint.join(fuzz_piece(rng, added) for _ in range(rng.randint(1, 8)))


if __name__ == "__main__":
    for name, make in ZOO.items():
        print(name, make().get_vocab_size(), file=sys.stderr)
