"""A small byte-pair vocabulary in the files that CLIP's tokenizer reads.

Source: Sennrich et al. 2016, "Neural machine translation of rare words with subword units" (byte-pair encoding);
Radford et al. 2021 (CLIP's layout: bytes as printable letters, "</w>" at a word's end, two marks at the end).
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

START, END = "<|startoftext|>", "<|endoftext|>"
WORD = re.compile(r"[^\W\d_]+|\d|[^\s\w]+|_+")  # letters together, digits alone, marks together: as CLIP splits


def byte_letters() -> list[str]:
    """The printable letter that stands for each byte: itself where it prints, else the next one from 256 on."""
    prints = {*range(33, 127), *range(161, 173), *range(174, 256)}
    letters, spare = [], 256
    for byte in range(256):
        letters.append(chr(byte if byte in prints else spare))
        spare += byte not in prints
    return letters


def learn_merges(texts: Iterable[str]) -> list[tuple[str, str]]:
    """Byte-pair merges after which every word of `texts` is one token; the most frequent pair goes first.

    A word counts once, however often it stands in the texts. Words that are not among them come out as pieces of those
    that are, or as bytes: no text is out of vocabulary.
    """
    letters = byte_letters()
    words = []
    for word in sorted({word for text in texts for word in WORD.findall(text.lower())}):
        pieces = [letters[byte] for byte in word.encode()]
        words.append([*pieces[:-1], pieces[-1] + "</w>"])
    merges = []
    while pairs := Counter(pair for word in words for pair in zip(word, word[1:], strict=False)):
        best = min(pairs, key=lambda pair: (-pairs[pair], pair))  # ties by the alphabet, so that it is one vocabulary
        merges.append(best)
        words = [_merged(word, best) for word in words]
    return merges


def _merged(word: list[str], pair: tuple[str, str]) -> list[str]:
    out: list[str] = []
    for piece in word:
        if out and (out[-1], piece) == pair:
            out[-1] += piece
        else:
            out.append(piece)
    return out


def vocabulary(merges: Iterable[tuple[str, str]]) -> dict[str, int]:
    """Token to number: the bytes, the bytes at a word's end, the merges, the marks of start and end."""
    letters = byte_letters()
    tokens = [*letters, *(letter + "</w>" for letter in letters), *(a + b for a, b in merges), START, END]
    return {token: i for i, token in enumerate(dict.fromkeys(tokens))}


def write_tokenizer(folder: Path, merges: list[tuple[str, str]], length: int) -> Path:
    """Write the files of a CLIPTokenizer that gives `length` tokens at most, marks of start and end among them."""
    marks = {"bos_token": START, "eos_token": END, "pad_token": END, "unk_token": END}
    config = {"tokenizer_class": "CLIPTokenizer", "model_max_length": length, "do_lower_case": True, **marks}
    files = {
        "vocab.json": json.dumps(vocabulary(merges), ensure_ascii=False),
        "merges.txt": "\n".join(["#version: 0.2", *(f"{a} {b}" for a, b in merges), ""]),
        "tokenizer_config.json": json.dumps(config, indent=2),
        "special_tokens_map.json": json.dumps(marks, indent=2),
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder
