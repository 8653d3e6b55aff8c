"""A small byte-pair vocabulary in the files that CLIP's tokenizer reads.

Source: Sennrich et al. 2016, "Neural machine translation of rare words with subword units" (byte-pair encoding);
Radford et al. 2021 (CLIP's layout: bytes as printable letters, "</w>" at a word's end, two marks at the end).
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path

from torch import Tensor

START, END = "<|startoftext|>", "<|endoftext|>"
SUFFIX = "</w>"  # of the last piece of a word
WORD = re.compile(r"[^\W\d_]+|\d|[^\s\w]+|_+")  # letters together, digits alone, marks together: as CLIP splits


def byte_letters() -> list[str]:
    """The printable letter that stands for each byte: itself where it prints, else the next one from 256 on."""
    prints = {*range(33, 127), *range(161, 173), *range(174, 256)}
    letters, spare = [], 256
    for byte in range(256):
        letters.append(chr(byte if byte in prints else spare))
        spare += byte not in prints
    return letters


def words_of(texts: Iterable[str]) -> list[str]:
    """The different words of `texts`, in lower case, sorted."""
    return sorted({word for text in texts for word in WORD.findall(text.lower())})


def learn_merges(texts: Iterable[str]) -> list[tuple[str, str]]:
    """Byte-pair merges after which every word of `texts` is one token, by the `tokenizers` library.

    A word counts once, however often it stands in the texts. Words that are not among them come out as pieces of those
    that are, or as bytes: no text is out of vocabulary. The same texts give the same merges; versions of the library
    may choose differently among pairs that are equally frequent, and so did versions of this file.
    """
    from tokenizers import Tokenizer, models, pre_tokenizers, trainers

    tokenizer = Tokenizer(models.BPE(end_of_word_suffix=SUFFIX))
    tokenizer.pre_tokenizer = pre_tokenizers.WhitespaceSplit()
    letters = byte_letters()
    words = ["".join(letters[byte] for byte in word.encode()) for word in words_of(texts)]
    first = list(vocabulary([]))[:-2]
    trainer = trainers.BpeTrainer(
        vocab_size=len(first) + sum(map(len, words)),  # never reached: it ends where every word is one token
        min_frequency=1,
        end_of_word_suffix=SUFFIX,
        special_tokens=first,  # numbers before training, or ties would be broken by chance
        show_progress=False,
    )
    tokenizer.train_from_iterator(words, trainer)
    merges = json.loads(tokenizer.to_str())["model"]["merges"]
    return [(a, b) for a, b in (pair.split(" ") if isinstance(pair, str) else pair for pair in merges)]


def unknown_words(texts: Iterable[str], merges: Iterable[tuple[str, str]]) -> list[str]:
    """The words of `texts` that are no token of their own after `merges`."""
    letters, tokens = byte_letters(), vocabulary(merges)
    return [word for word in words_of(texts) if "".join(letters[b] for b in word.encode()) + SUFFIX not in tokens]


def vocabulary(merges: Iterable[tuple[str, str]]) -> dict[str, int]:
    """Token to number: the bytes, the bytes at a word's end, the merges, the marks of start and end."""
    letters = byte_letters()
    tokens = [*letters, *(letter + SUFFIX for letter in letters), *(a + b for a, b in merges), START, END]
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


class Tokens:
    """Texts to token numbers, by the tokenizer that is written with the model; each text is looked up once."""

    def __init__(self, folder: Path, merges: list[tuple[str, str]], length: int):
        from transformers import CLIPTokenizer

        self._tokenizer = CLIPTokenizer.from_pretrained(write_tokenizer(folder, merges, length))
        self._options = dict(padding="max_length", max_length=length, truncation=True, return_tensors="pt")
        self._known: dict[str, Tensor] = {}

    def __call__(self, text: str) -> Tensor:
        """Token numbers [L] of one text."""
        if text not in self._known:
            self._known[text] = self._tokenizer(text, **self._options).input_ids[0]
        return self._known[text]
