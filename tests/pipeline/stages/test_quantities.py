"""docs/quantities.md names every array that a stage hands on, and no other."""

import dataclasses
import importlib
import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np

import pipeline.stages

PAGE = Path(__file__).parents[3] / "docs" / "quantities.md"
WITHOUT_ARRAYS = {"Staged", "Pending", "ReconstructionContext"}  # they carry products, or what a stage reads


def holds_array(annotation: Any) -> bool:
    """An array, one of jaxtyping's, or a container of them."""
    if isinstance(annotation, type) and (issubclass(annotation, np.ndarray) or hasattr(annotation, "array_type")):
        return True
    return any(map(holds_array, get_args(annotation)))


def classes_of(annotation: Any) -> Iterator[type]:
    if isinstance(annotation, type) and dataclasses.is_dataclass(annotation):
        yield annotation
    for inner in get_args(annotation):
        yield from classes_of(inner)


def arrays_of(products: list[type]) -> set[str]:
    """The public array fields of the products and of the classes that their fields name."""
    hints = {product: get_type_hints(product) for product in products}
    named = {each for fields in hints.values() for annotation in fields.values() for each in classes_of(annotation)}
    return {
        f"{each.__name__}.{name}"
        for each in {*products, *named}
        for name, annotation in get_type_hints(each).items()
        if holds_array(annotation) and not name.startswith("_")
    }


def test_the_page_names_every_array_that_a_stage_hands_on() -> None:
    stages = [each.name for each in pkgutil.iter_modules(pipeline.stages.__path__)]
    modules = [importlib.import_module(f"pipeline.stages.{stage}") for stage in stages]
    products = [
        value
        for module in modules
        for name, value in vars(module).items()
        if isinstance(value, type)
        and dataclasses.is_dataclass(value)
        and value.__module__ == module.__name__
        and name not in WITHOUT_ARRAYS
    ]
    stated = re.findall(r"^\| `(\w+\.\w+)` \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert len(products) > 10
    assert len(stated) == len(set(stated))
    assert set(stated) == arrays_of(products)


def test_an_array_that_the_page_lacks_is_found() -> None:
    @dataclasses.dataclass(frozen=True)
    class Inner:
        height_mm: np.ndarray

    @dataclasses.dataclass(frozen=True)
    class Outer:
        by_camera: dict[str, Inner]
        count: int

    assert arrays_of([Outer]) == {"Inner.height_mm"}
