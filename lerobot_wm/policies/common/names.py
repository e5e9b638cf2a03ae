"""Names of features before and after `--rename_map`."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from types import MappingProxyType

from lerobot.configs import PolicyFeature

OWN_NAMES: Mapping[str, str] = MappingProxyType({})  # the rename_map that changes no name


def renamed(features: Mapping[str, PolicyFeature], rename_map: Mapping[str, str]) -> dict[str, PolicyFeature]:
    """The features of a dataset or environment under the names that `--rename_map` gives them.

    Raises:
        ValueError: Two get the same name; which one is read would depend on their order.
    """
    names = {old: rename_map.get(old, old) for old in features}
    for old, new in names.items():
        others = [key for key, name in names.items() if name == new and key != old]
        if others:
            raise ValueError(
                f"--rename_map: '{old}' and '{others[0]}' would both be named '{new}'. Give the one that is not to be "
                "read another name too."
            )
    return {names[old]: feature for old, feature in features.items()}


def names_before(keys: Iterable[str], rename_map: Mapping[str, str]) -> list[str]:
    """The names that features have in the dataset itself, before `--rename_map` gives them these `keys`."""
    before = {new: old for old, new in rename_map.items()}
    return [before.get(key, key) for key in keys]


_RENAME_MAP: ContextVar[Mapping[str, str]] = ContextVar("rename_map", default=OWN_NAMES)


@contextmanager
def names_given_by(rename_map: Mapping[str, str]) -> Iterator[None]:
    """Let policies that are loaded here know `--rename_map`, which LeRobot gives to its processors only."""
    token = _RENAME_MAP.set(rename_map)
    try:
        yield
    finally:
        _RENAME_MAP.reset(token)


def current_names() -> Mapping[str, str]:
    """The rename_map of the surrounding `names_given_by`."""
    return _RENAME_MAP.get()


def recorded_name(key: str) -> str:
    """The name that a feature of the surrounding `names_given_by` has in the dataset itself."""
    [name] = names_before([key], current_names())
    return name
