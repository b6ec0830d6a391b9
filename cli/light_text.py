"""What light a layer holds, for people."""

from collections.abc import Iterable

from schemas.light import LeftOut, Light


def sun_text(light: Light) -> str:
    """Return where the sun stands."""
    text = f"azimuth {light.azimuth_deg:.2f}, elevation {light.elevation_deg:.2f} degrees"
    if light.when is not None:
        text += f", at {light.when}"
    return text if light.elevation_deg > 0 else f"{text}: below the horizon"


def effects_text(light: Light) -> str:
    """Return what was simulated."""
    effects = [
        {"none": "no shadows", "hard": f"hard shadows ({light.lines} per sample)"}.get(light.shadows, f"{light.shadows} shadows"),
        (f"sky ({light.sky_azimuths} azimuths)" if light.sky_azimuths else "open sky") if light.sky_share else "",
        "bounce" if light.albedo else "",
        "curvature" if light.radius_m is not None else "",
        "refraction" if light.refraction else "",
    ]
    return ", ".join(effect for effect in effects if effect)


def left_out_texts(left_out: Iterable[LeftOut]) -> list[str]:
    """Return, per effect that was left out, why."""
    lines = []
    for one in left_out:
        unit = "degrees" if one.unit == "degrees of sun" else one.unit
        bound = "without a bound" if one.bound is None else f"at most {one.bound:.3g} {unit}"
        why = "estimated to change little, " if one.estimated else "proved to change "
        lines.append(f"{one.effect.replace('_', ' ')}: {why}{bound}")
    return lines


def light_pairs(light: Light) -> list[tuple[str, str]]:
    """Return names and texts of what a layer of light is."""
    pairs = [("sun", sun_text(light)), ("effects", effects_text(light))]
    return pairs + [("left out" if number == 0 else "", line) for number, line in enumerate(left_out_texts(light.left_out))]
