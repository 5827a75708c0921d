# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""Writes unicode_classes.inc and unicode_lower.inc: characters as the reference tokenizer sees them, found by asking it.

    python tests/reference/make_unicode_classes.py src/processor

Needs the Hugging Face `tokenizers` package, the release that the lab environment pins.  Every code point is put through the
engines that look at characters (the regular expression of ByteLevel, Digits, the word and space tests of added tokens, BERT's
normalization and splitting), and what each did with it is recorded.  Code points are not read from Python's own Unicode tables, whose
version is another.
"""

import sys

import tokenizers
from tokenizers import AddedToken, Tokenizer, models, normalizers, pre_tokenizers
from unicode_tables import CODE_POINTS, write_classes, write_lowered

LETTER, NUMBER, SPACE, DIGIT, WORD, NORMAL, CONTROL, PUNCTUATION, MARK = (1 << i for i in range(9))


def added_token_tokenizer(**options) -> Tokenizer:
    tokenizer = Tokenizer(models.BPE(vocab={"a": 0}, merges=[], unk_token=None))
    tokenizer.add_tokens([AddedToken("qz", normalized=False, **options)])
    return tokenizer


def normal() -> set[int]:
    """Code points that decompose, that decompositions are made of, and marks, which are put in the order of their classes."""
    nfd, found = normalizers.NFD(), set()
    for c in map(chr, CODE_POINTS):
        parts = nfd.normalize_str(c)
        low, high = "\u0327", "\u0345"  # marks of a low and of the highest class change places with others
        if parts != c:
            found.update([ord(c), *map(ord, parts)])
        if nfd.normalize_str(c + low) != c + low or nfd.normalize_str(high + c) != high + c:
            found.add(ord(c))
    return found | {ord("\u0327"), ord("\u0345")}


def bert(**steps):
    """BERT's normalization with these of its steps."""
    every = dict.fromkeys(("clean_text", "handle_chinese_chars", "strip_accents", "lowercase"), False)
    return normalizers.BertNormalizer(**every | steps).normalize_str


def classify_for_bert(flags: list[int]) -> None:
    clean, strip, nfd = bert(clean_text=True), bert(strip_accents=True), normalizers.NFD()
    words = pre_tokenizers.BertPreTokenizer()
    for c in CODE_POINTS:
        cleaned = clean(chr(c))
        flags[c] |= CONTROL * (cleaned == "") + MARK * (strip(chr(c)) == "")
        flags[c] |= PUNCTUATION * (len(words.pre_tokenize_str("a" + chr(c) + "a")) == 3)
        # What is left is a blank where \s says so, and else itself; accents go character by character.
        assert cleaned in ("", " " if flags[c] & SPACE else chr(c)), hex(c)
    for c in CODE_POINTS:
        assert strip(chr(c)) == "".join(x for x in nfd.normalize_str(chr(c)) if not flags[ord(x)] & MARK), hex(c)


def classify() -> list[int]:
    flags = [0] * 0x110000
    for c in normal():
        flags[c] |= NORMAL
    pieces = pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=True)
    digits = pre_tokenizers.Digits(individual_digits=True)
    for c in CODE_POINTS:
        joins = [len(pieces.pre_tokenize_str(head + chr(c))) == 1 for head in "a1!\t"]
        # Each class of the expression is closed under concatenation with itself and with no other.
        assert sum(joins) == 1, (hex(c), joins)
        flags[c] |= (LETTER, NUMBER, 0, SPACE)[joins.index(True)]
        if len(digits.pre_tokenize_str("a" + chr(c))) == 2:
            flags[c] |= DIGIT
    word, strip = added_token_tokenizer(single_word=True), added_token_tokenizer(rstrip=True)
    for start in range(0, len(CODE_POINTS), 65536):
        block = CODE_POINTS[start : start + 65536]
        for c, encoding in zip(block, word.encode_batch(["qz" + chr(c) for c in block])):
            if 1 not in encoding.ids:  # the added token is not alone, so its neighbour is a word character
                flags[c] |= WORD
        for c, encoding in zip(block, strip.encode_batch(["qz" + chr(c) for c in block])):
            # Two engines test for white space; one class serves both as long as they agree.
            assert (encoding.offsets[0][1] == 3) == bool(flags[c] & SPACE), hex(c)
    classify_for_bert(flags)
    return flags


def main() -> None:
    source = f"tests/reference/make_unicode_classes.py from tokenizers {tokenizers.__version__}"
    write_classes(sys.argv[1] + "/unicode_classes.inc", source, classify())
    write_lowered(sys.argv[1] + "/unicode_lower.inc", source, bert(lowercase=True))


main()
