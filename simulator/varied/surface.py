"""The road's surface in one scene. The defaults leave the surface as the track's scenery has it."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Surface:
    """The road's surface in one scene; see ranges.toml, section [surface]."""

    tone: float = 0.0
    """Albedo of the asphalt; 0: the albedo of the track's scenery."""
    warmth: float = 0.0
    """Excess of red over blue in the asphalt's colour, as a share."""
    other_tone: float = 0.0
    """Albedo of a second material, whose sections alternate with the first; 0: no such material."""
    section_m: float = 100.0
    """Mean length of a section of either material, m."""
    concrete: float = 0.0
    """Sections made of concrete slabs: 0 none, 1 the sections of both materials, -1 of the second
    only."""
    joint_m: float = 5.0
    """Distance between the joints of concrete slabs."""
    halves: float = 0.0
    """Difference in tone of the two sides of a lengthwise seam, as a share."""
    seam_m: float = 0.0
    """Lateral position of that seam, left of the road's centre."""
    tar: float = 0.0
    """How many of the seams and cracks are filled with tar, 0 to 1."""
    patches: float = 0.0
    """Share of the surface in patches of another tone."""
    patch_tone: float = 0.7
    tracks: float = 0.14
    """Share by which wheels have darkened the surface; negative: brightened."""
    grain: float = 1.0
    puddles: float = 0.0
    """Share of the surface under water."""
    ragged_m: float = 0.0
    """How far the asphalt's edge deviates from a straight line."""
    gravel_m: float = 0.0
    """Width of a strip of gravel beside the asphalt."""
    kerb_m: float = 0.0
    """Width of kerb stones beside the asphalt; 0: none."""
    phase: float = 0.0
