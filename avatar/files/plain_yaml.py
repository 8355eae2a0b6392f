"""YAML files that people pass on, as plain values: no Python objects, no aliases, a bounded number of short values."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from avatar.errors import UserError
from avatar.files.read import read_text

MAX_NODES = 50_000  # values and keys
MAX_DIGITS = 25  # of a whole number


def read_yaml(path: Path, limit: int) -> Any:
    """The values in a file of at most `limit` bytes. Raises UserError naming the file and what is wrong with it."""
    text = read_text(path, limit)
    try:
        return yaml.load(text, _PlainLoader)
    except (yaml.YAMLError, ValueError, LookupError, AttributeError, RecursionError) as error:  # of tagged scalars
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise UserError(f"{path} cannot be read as YAML ({reason})") from None


class _PlainLoader(yaml.SafeLoader):
    """Refuses aliases: with them, a few bytes stand for gigabytes."""

    nodes = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("aliases (*name) are not allowed")
        self.nodes += 1
        if self.nodes > MAX_NODES:
            raise yaml.YAMLError(f"it holds more than {MAX_NODES:,} values")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.YAMLError("a key is a list or a table, not text")
            if key.value in seen:
                raise yaml.YAMLError(f"{key.value!r} stands there twice")
            seen.add(key.value)
        made = super().construct_mapping(node, deep)
        if len(made) < len(seen):
            raise yaml.YAMLError("two keys mean the same, such as 1 and yes: put one in quotes")
        return made

    def construct_yaml_int(self, node: Any) -> int:
        if len(node.value) > MAX_DIGITS:
            raise yaml.YAMLError(f"a number has more than {MAX_DIGITS} digits")
        return super().construct_yaml_int(node)


_PlainLoader.add_constructor("tag:yaml.org,2002:int", _PlainLoader.construct_yaml_int)
