"""Models of diffusers and transformers by folder or by Hugging Face id: found, checked, and loaded whole."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import torch

from ..errors import PriorError

SHIPPED_NAME, SHIPPED = "demo:prior", Path(__file__).resolve().parents[1] / "demo" / "prior"


def find_folder(path: str, holds: str, example: str) -> Path | None:
    """The local folder `path`, or None where it can be an id of the hub. Raises PriorError where it is neither.

    holds: what belongs into the folder; example: an id; both for the message. "demo:prior" is the small model that lies
    in this package.
    """
    folder = SHIPPED if path == SHIPPED_NAME else Path(path).expanduser()
    if folder.is_dir():
        return folder
    if folder.is_absolute() or path.startswith((".", "~")) or len(folder.parts) != 2:
        raise PriorError(
            f"{path}: no such folder. Give a folder with {holds}, or a Hugging Face id such as '{example}'."
        )
    return None


def not_given(path: str, error: Exception) -> str:
    """The message for an id of the hub that could not be had."""
    return (
        f"{path}: no such folder here, not in the cache of Hugging Face, and the hub did not give it "
        f"({type(error).__name__}). Where there is no network, run `hf download {path}` on a machine that has it, "
        f"copy the folder, and give its path (or set HF_HOME to that cache)."
    )


def model_config(path: str, holds: str, examples: Mapping[str, str]) -> Any:
    """transformers' config of the model `path` (a local folder, or a Hugging Face id that is downloaded once).

    holds: what belongs into the folder; examples: the kinds that will do, as config.json calls them (model_type), with
    an id each. Raises PriorError: no such folder, an id that cannot be had, another kind of model.
    """
    from transformers import AutoConfig

    folder = find_folder(path, holds, next(iter(examples.values())))
    try:
        config = AutoConfig.from_pretrained(path)
    except (OSError, ValueError, KeyError) as error:
        fault = not_given(path, error) if folder is None else f"{path}: has no config.json of a model that is known."
        raise PriorError(fault) from error
    if config.model_type not in examples:
        good = " or ".join(f"{name} (such as {example})" for name, example in examples.items())
        raise PriorError(f"{path}: is a '{config.model_type}', expected {good}.")
    return config


def load(kind: type, path: str | Path, subfolder: str | None, dtype: torch.dtype) -> Any:
    """A frozen model of diffusers or transformers in evaluation mode, every weight found. Raises PriorError."""
    from diffusers import ModelMixin
    from diffusers.utils import is_accelerate_available

    where = Path(path, subfolder) if subfolder else path
    options: dict[str, Any] = {"subfolder": subfolder} if subfolder else {}
    if issubclass(kind, ModelMixin):
        options |= {"torch_dtype": dtype, "low_cpu_mem_usage": is_accelerate_available()}
    try:
        model, info = cast(Any, kind).from_pretrained(str(path), output_loading_info=True, **options)
    except Exception as error:  # each way to store weights raises its own kinds
        raise PriorError(
            f"{where}: cannot be loaded as {kind.__name__}: {first_line(error)} "
            f"Give a complete folder, or an id that the hub or its local cache has."
        ) from error
    if info["missing_keys"]:
        raise PriorError(
            f"{where}: {len(info['missing_keys'])} weights of {kind.__name__} are missing, the first "
            f"'{sorted(info['missing_keys'])[0]}'. Download the folder again; its config and weights do not match."
        )
    if model.dtype != dtype:
        model = model.to(dtype)
    return model.requires_grad_(False).eval()


def load_processor(kind: type, path: str | Path, files: str, subfolder: str | None = None) -> Any:
    """A tokenizer or image processor of transformers. files: what it needs, for the message. Raises PriorError."""
    options: dict[str, Any] = {"subfolder": subfolder} if subfolder else {}
    try:
        return cast(Any, kind).from_pretrained(str(path), **options)
    except Exception as error:  # the libraries under it raise their own kinds
        raise PriorError(
            f"{Path(path, subfolder) if subfolder else path}: cannot be loaded as {kind.__name__}: {first_line(error)} "
            f"It needs {files}; download the folder again."
        ) from error


def first_line(error: Exception) -> str:
    """The kind of an error and the first line of what it says."""
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0][:200]}"
