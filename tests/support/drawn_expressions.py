"""Draws expressions of a head at random."""

import numpy as np

from pipeline.head_model.expressions import plain_name

SMILING, SMILES = 0.6, ("mouthSmileLeft", "mouthSmileRight")
FEW, MANY, WEIGHTS = 3, 7, (0.15, 0.8)
JAW = 0.4  # of a drawn weight: a mouth that is half open is wide open


def drawn_weights(rng: np.random.Generator, names: tuple[str, ...]) -> dict[str, float]:
    """Draws a few expressions at random; more often than not among them a smile about as strong on both sides."""
    chosen = rng.choice(len(names), rng.integers(FEW, MANY), replace=False)
    found = {names[k]: float(rng.uniform(*WEIGHTS)) for k in chosen}
    if rng.random() < SMILING:
        strength = rng.uniform(0.2, 0.7)
        for name in names:
            if plain_name(name) in SMILES:
                found[name] = float(np.clip(strength + rng.normal(0.0, 0.08), 0.0, 1.0))
    for name in ("jawOpen", "mouth-open"):
        if name in found:
            found[name] *= JAW
    if "mouthClose" in found:  # of an open jaw: lips that close without one pass through each other
        found["mouthClose"] = min(found["mouthClose"], 0.5 * found.get("jawOpen", 0.0))
    return {name: weight for name, weight in found.items() if weight > 0.0}
