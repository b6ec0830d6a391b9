"""What a layer of light is simulated with: the effects that a plan (``tiler.effects``) does not prove to be too small to be seen.

A plan only takes away from what was asked for. What is left out is noted in the settings, and so in the manifest.
"""

from collections.abc import Callable, Iterator
from time import perf_counter
from typing import Any, Final, Literal, cast

from schemas.effects import EffectName, EffectPlan
from schemas.errors import UsageError
from schemas.light import LeftOut
from schemas.scene import EARTH_RADIUS_M, Effects, Scene, Sky, Sun, Tolerance
from schemas.settings import LightSettings
from tiler.building.light import REFRACTION, open_light
from tiler.effects.dataset import measure_dataset
from tiler.stores.dataset import Dataset
from tiler.tasks.records import RecordBook

_SWITCHES: Final = ("shadows", "sky", "open_sky", "bounce", "curvature", "refraction")
"""Settings that a plan may change."""
_NO_EFFECT: Final = ("task", "workers", "overwrite", "update", "records", "left_out", "break_lock")
"""Settings on which the light does not depend."""
_RANKS: Final = {"none": 0, "hard": 1, "certified": 1, "soft": 2}
_CURVED: Final[tuple[EffectName, ...]] = ("curvature_shadow", "curvature_sky", "sun_direction")
_BENT: Final[tuple[EffectName, ...]] = ("refraction_sun", "refraction_path")
_PART_OF: Final[dict[EffectName, EffectName]] = {"curvature_shadow": "shadow", "curvature_sky": "sky", "refraction_path": "shadow"}
_LEAST_AZIMUTHS: Final = 4
_NO_TURN_DEG: Final = 1e-9
"""A hard edge that moves at all changes single samples entirely: unless a scene allows it, what moves edges is simulated. It costs next to
nothing."""


def scene_of(settings: LightSettings, codes: float) -> Scene:
    """Return the scene that ``settings`` describe, of which everything together that ``codes`` [codes of light] allow may be left out.

    By proof alone. What the settings do not ask for is off. Raises UsageError if horizons are looked for in less than four azimuths, or
    ``codes`` is no tolerance.
    """
    if not 0 < codes <= 255:
        raise UsageError(f"--tolerance {codes:g}: codes of light are more than 0, up to 255")
    if 0 < settings.sky < _LEAST_AZIMUTHS:
        raise UsageError(f"--sky {settings.sky}: --effects auto needs at least {_LEAST_AZIMUTHS} azimuths")
    sky, shadow = settings.sky > 0, settings.shadows != "none"
    asked: dict[EffectName, bool] = {
        "shadow": shadow,
        "penumbra": settings.shadows == "soft",
        "sky": sky,
        "bounce": settings.bounce,
        "curvature_shadow": settings.curvature and shadow,
        "curvature_sky": settings.curvature and (sky or settings.bounce),
        "sun_direction": settings.curvature,
        "refraction_sun": settings.refraction,
        "refraction_path": settings.refraction and shadow,
    }
    return Scene.model_validate(
        {
            "sun": Sun(
                azimuth_deg=settings.azimuth_deg,
                elevation_deg=settings.elevation_deg,
                when=settings.when,
                radius_deg=settings.radius_deg if asked["penumbra"] else 0.0,
            ),
            "sky": Sky(share=settings.share, azimuths=settings.sky) if sky else Sky(share=settings.share if settings.open_sky else 0.0),
            "ground": {"albedo": settings.albedo if settings.bounce else 0.0},
            "air": {"refraction": REFRACTION if settings.refraction else 0.0},
            "tolerance": Tolerance(codes=codes, sun_deg=_NO_TURN_DEG, estimates=False),
            "effects": Effects.model_validate({name: "auto" if wanted else "off" for name, wanted in asked.items()}),
        }
    )


def settings_of(scene: Scene, settings: LightSettings) -> LightSettings:
    """Return ``settings`` with the sun and with all effects of ``scene``, but for those that are off.

    Raises UsageError if it asks for another globe or other air than light is simulated with.
    """
    effects, bend = scene.effects, scene.air.refraction
    if scene.ground.radius_m != EARTH_RADIUS_M:
        raise UsageError(f"the scene's ground.radius_m: light is simulated on the Earth, whose radius is {EARTH_RADIUS_M} m; leave it out")
    if bend not in (0.0, REFRACTION):
        raise UsageError(f"the scene's air.refraction: light is simulated with {REFRACTION} or without air, 0; give one of these")
    soft = scene.sun.radius_deg > 0 and effects.penumbra != "off"
    shadows = "none" if effects.shadow == "off" else "soft" if soft else "certified" if settings.shadows == "certified" else "hard"
    seen, lit = scene.sky.share > 0, effects.sky != "off"
    changed: dict[str, Any] = {
        "azimuth_deg": scene.sun.azimuth_deg,
        "elevation_deg": scene.sun.elevation_deg,
        "when": scene.sun.when,
        "shadows": shadows,
        "sky": scene.sky.azimuths if seen and lit else 0,
        "open_sky": seen and not lit,
        "bounce": scene.ground.albedo > 0 and effects.bounce != "off",
        "curvature": any(getattr(effects, name) != "off" for name in _CURVED),
        "refraction": bend > 0 and any(getattr(effects, name) != "off" for name in _BENT),
    }
    # Settings of what is not simulated have limits all the same.
    changed |= {"radius_deg": scene.sun.radius_deg} if shadows == "soft" else {}
    changed |= {"share": scene.sky.share} if seen else {}
    changed |= {"albedo": scene.ground.albedo} if changed["bounce"] else {}
    return settings.model_copy(update=changed)


def settings_for(plan: EffectPlan, settings: LightSettings) -> LightSettings:
    """Return ``settings`` with everything switched off that ``plan`` leaves out, and noted as such.

    What hides the sky is found by the same horizons as what the ground reflects, so it is left out only with that; curvature and
    refraction, which take next to no time, are one switch each, and go only if all that they change may go.
    """
    runs = {one.effect: one.runs for one in plan.effects}
    shadows = settings.shadows if runs["shadow"] or runs["penumbra"] else "none"
    if shadows == "soft" and not runs["penumbra"]:
        shadows = "hard"
    bounce = settings.bounce and runs["bounce"]
    sky = settings.sky if runs["sky"] or bounce else 0
    # The plan says what curvature changes of the sky, not what it changes of reflections.
    curvature = settings.curvature and (bounce or any(runs[name] for name in _CURVED) or (shadows != "none" and _is_low(plan, settings)))
    # Curved ground is seen over bent rays as ground of a globe that is a seventh larger, of which the plan says nothing by itself.
    refraction = settings.refraction and (curvature or any(runs[name] for name in _BENT))
    chosen = settings.model_copy(
        update={
            "shadows": shadows,
            "sky": sky,
            "open_sky": settings.open_sky or (settings.sky > 0 and not sky),
            "bounce": bounce,
            "curvature": curvature,
            "refraction": refraction,
        }
    )
    return chosen.model_copy(update={"left_out": tuple(_left_out(plan, settings, chosen))})


def _is_low(plan: EffectPlan, settings: LightSettings) -> bool:
    """Whether part of the sun may stand below the horizontal: then the horizon beyond the map counts, which is lower on a globe."""
    turn = plan.effect("sun_direction")
    turn_deg = turn.bound or 0.0 if turn.unit == "degrees of sun" else 0.0
    return plan.elevation_deg <= turn_deg + (settings.radius_deg if settings.shadows == "soft" else 0.0)


def _left_out(plan: EffectPlan, asked: LightSettings, chosen: LightSettings) -> Iterator[LeftOut]:
    """Yield the effects that are asked for and not chosen."""
    gone: dict[EffectName, bool] = {
        "shadow": asked.shadows != "none" and chosen.shadows == "none",
        "penumbra": asked.shadows == "soft" != chosen.shadows,
        "sky": asked.sky > 0 and not chosen.sky,
        "bounce": asked.bounce and not chosen.bounce,
        **dict.fromkeys(_CURVED, asked.curvature and not chosen.curvature),
        **dict.fromkeys(_BENT, asked.refraction and not chosen.refraction),
    }
    for name, is_gone in gone.items():
        one, whole = plan.effect(name), _PART_OF.get(name)
        # A part of something that is gone as a whole is nothing by itself.
        if is_gone and one.verdict != "forced off" and not (whole is not None and not plan.effect(whole).runs):
            unit = cast("Literal['codes', 'degrees of sun']", one.unit)
            yield LeftOut(effect=name, bound=one.bound, unit=unit, estimated=one.verdict == "skip estimated")


def saved_s(plan: EffectPlan, chosen: LightSettings) -> dict[str, float]:
    """Return the processor time [s] that leaving out each effect saves, by the plan's estimate."""
    return {one.effect: plan.effect(cast("EffectName", one.effect)).cost_s for one in chosen.left_out}


class EffectChoice:
    """Chooses the effects of one layer of light for ``build_light``: measures the heights under ``scene``, and plans.

    Afterwards ``plan`` is the plan, ``chosen`` what is simulated, ``keeps_more`` whether a layer that is there has effects that the plan
    does not call for, and ``wall_s`` the time it took.
    """

    def __init__(self, scene: Scene, on_progress: Callable[[int, int], None] = lambda done, total: None) -> None:
        self._scene, self._on_progress = scene, on_progress
        self.plan: EffectPlan | None = None
        self.chosen: LightSettings | None = None
        self.keeps_more = False
        self.wall_s = 0.0

    def __call__(self, dataset: Dataset, settings: LightSettings) -> LightSettings:
        """Return ``settings`` with what the plan leaves of them.

        A layer that is there and holds more than the plan calls for stays as it is, so that an update of the heights changes nothing
        but what it must. Raises UsageError if it holds less, or if light between the heights is asked for, and what opening the light and
        measuring the heights raise.
        """
        started = perf_counter()
        if settings.density != 1:
            raise UsageError("--twice: effects are planned for heights as they are stored, not for twice as many; leave out --effects auto")
        # What is wrong with the settings is said before the heights are read.
        open_light(dataset, settings)[1].close()
        measured = measure_dataset(dataset, settings.height, self._scene, settings.workers, self._on_progress)
        self.plan = measured.plan()
        needed = settings_for(self.plan, settings)
        self.chosen = _beside(dataset, self.plan, settings, needed)
        self.keeps_more = any(getattr(self.chosen, name) != getattr(needed, name) for name in _SWITCHES)
        self.wall_s = perf_counter() - started
        return self.chosen


def _beside(dataset: Dataset, plan: EffectPlan, asked: LightSettings, needed: LightSettings) -> LightSettings:
    """Return what is simulated, given what the layer holds that is there."""
    layer = dataset.manifest.layers.get(asked.layer)
    record = None if layer is None or asked.overwrite else RecordBook(dataset.store, layer.path).plan()
    found = None if record is None else record.light
    if found is None or not _is_choice(found, asked):
        return needed
    if missing := _missing(found, needed):
        raise UsageError(
            f"{dataset.store.location}: layer {asked.layer!r} was built without {', '.join(missing)}, for which its heights and the "
            "tolerance call now; add --overwrite to build it anew"
        )
    chosen = asked.model_copy(update={name: getattr(found, name) for name in _SWITCHES})
    return chosen.model_copy(update={"left_out": tuple(_left_out(plan, asked, chosen))})


def _is_choice(found: LightSettings, asked: LightSettings) -> bool:
    """Whether a plan can have chosen ``found`` when it was asked for the same."""
    if found.model_copy(update={name: getattr(asked, name) for name in (*_SWITCHES, *_NO_EFFECT)}) != asked:
        return False
    return (
        found.shadows in ("none", asked.shadows, *(["hard"] if asked.shadows == "soft" else []))
        and (found.sky, found.open_sky) in ((asked.sky, asked.open_sky), (0, asked.open_sky or asked.sky > 0))
        and all(getattr(found, name) <= getattr(asked, name) for name in ("bounce", "curvature", "refraction"))
    )


def _missing(found: LightSettings, needed: LightSettings) -> list[str]:
    """Return what ``needed`` simulates and ``found`` does not."""
    shadows = {1: "shadows", 2: "soft shadows"}[_RANKS[needed.shadows]] if _RANKS[found.shadows] < _RANKS[needed.shadows] else ""
    named = {"sky": "what hides the sky", "bounce": "reflected light", "curvature": "curvature", "refraction": "refraction"}
    return [shadows] * bool(shadows) + [words for name, words in named.items() if getattr(needed, name) and not getattr(found, name)]
