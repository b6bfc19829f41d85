"""The road's surface in one scene. Defaults are today's pictures."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Surface:
    """The road's surface in one scene; see ranges.toml, section [surface]."""

    tone: float = 0.0
    """Albedo of the asphalt; 0: that of the track's scenery."""
    warmth: float = 0.0
    """Of its colour: red above blue, as a share."""
    other_tone: float = 0.0
    """Albedo of the other material, sections of which interrupt the first; 0: none."""
    section_m: float = 100.0
    """Mean length of a section of either material."""
    concrete: float = 0.0
    """Share of the sections that is concrete slabs; negative: the other material is."""
    joint_m: float = 5.0
    """Distance of the joints between concrete slabs."""
    halves: float = 0.0
    """Difference in tone of the two sides of a lengthwise seam, as a share."""
    seam_m: float = 0.0
    """Place of that seam, left of the road's centre."""
    tar: float = 0.0
    """How many of the seams and cracks are filled with tar, 0 to 1."""
    patches: float = 0.0
    """Share of the surface in patches of another tone."""
    patch_tone: float = 0.7
    tracks: float = 0.14
    """How much darker wheels have made the surface; negative: brighter."""
    grain: float = 1.0
    puddles: float = 0.0
    """Share of the surface under water."""
    ragged_m: float = 0.0
    """How far the asphalt's edge wanders."""
    gravel_m: float = 0.0
    """Width of a strip of gravel beside the asphalt."""
    kerb_m: float = 0.0
    """Width of kerb stones beside the asphalt; 0: none."""
    phase: float = 0.0
