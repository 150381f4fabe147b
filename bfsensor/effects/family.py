"""Families of effects: classes of the library, and templates that a simulation gave.

A diagnosis searches through families and calls them with values of their parameters.  A class of
the library is a family by itself.  Physics that depends on the baseline, such as a quantity of its
device, is a :class:`TemplateFamily`: one class that acts, with a name and a template.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from bfsensor.effects.effect import Effect, Layout, Parameter, Seen


@dataclass(frozen=True)
class TemplateFamily:
    """Effects of one class that act by the same template.

    Attributes
    ----------
    effect : type
        Subclass of :class:`TemplateEffect` that acts by the template.
    word, variant : str
        Name in the taxonomy, and the variant that distinguishes it from others of this name.
    template : object
        Data that ``effect`` acts by, such as simulated changes of the boundary shifts.
    source : str
        Origin of the template, for reports.
    parameters : tuple of Parameter
        The strength or value, and parameters of the shape.

    Notes
    -----
    Families are equal where all of this is, and so are their effects, in every process.
    """

    effect: type[TemplateEffect] = field(compare=False)
    word: str = field(compare=False)
    variant: str = field(compare=False)
    template: Any = field(compare=False, repr=False)
    source: str = field(compare=False)
    parameters: tuple[Parameter, ...] = field(compare=False)
    digest: str = field(init=False, repr=False)

    def __post_init__(self) -> None:
        given = self.word, self.variant, self.template, self.source, self.parameters
        text = pickle.dumps((self.effect.__name__, given))
        object.__setattr__(self, "digest", hashlib.sha256(text).hexdigest())

    def __call__(self, values: Mapping[str, float]) -> TemplateEffect:
        """Make the effect with values of its parameters."""
        return self.effect(values, self)

    @property
    def touches(self) -> tuple[str, ...]:
        """Names of the channels that the effects can change."""
        return self.effect.touches

    @property
    def needs(self) -> tuple[str, ...]:
        """Properties that recordings must have, as :attr:`Effect.needs`."""
        return self.effect.needs

    def starts(self, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        """Values from which fits begin, as :meth:`Effect.starts`."""
        return self.effect.template_starts(self, layout, seen)


EffectFamily = type[Effect] | TemplateFamily
"""Callable that makes an effect from values of its parameters."""


@dataclass(frozen=True, eq=False)
class TemplateEffect(Effect):
    """Effect that acts by the template of its family.

    Parameters
    ----------
    values : mapping of str to float
        Value of every parameter of the family.
    of : TemplateFamily
        Family with the name, the parameters and the template.
    """

    of: TemplateFamily

    def __post_init__(self) -> None:
        for name in ("word", "variant", "source", "parameters"):
            object.__setattr__(self, name, getattr(self.of, name))
        super().__post_init__()

    @property
    def family(self) -> EffectFamily:
        return self.of

    @property
    def template(self) -> Any:
        """Template of the family."""
        return self.of.template

    @classmethod
    def template_starts(
        cls, of: TemplateFamily, layout: Layout, seen: Sequence[Seen]
    ) -> list[dict[str, float]]:
        """Values from which fits of a family begin; every subclass has its own."""
        raise NotImplementedError(f"{cls.__name__} has no starts")

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (dict(self.values), self.of)
