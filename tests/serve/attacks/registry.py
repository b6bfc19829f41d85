"""All attacks, in the order of `make attack`."""

from tests.serve.attacks.attacks import CONNECTIONS, Attack
from tests.serve.attacks.costs import REQUESTS
from tests.serve.attacks.websockets import WEBSOCKETS

ATTACKS: tuple[Attack, ...] = (*CONNECTIONS, *WEBSOCKETS, *REQUESTS)
REPORTED = (
    *("long_upgrades", "crowded_upgrades", "endless_trailers", "idle_connections"),
    *("left_uploads", "refused_uploads", "unread_pings", "empty_fragments", "deep_texts"),
    *("fill_bytes", "repeated_outputs", "costly_images", "large_bodies", "h2c_in_two_segments"),
    *("rebound_names", "guessed_tokens", "forged_addresses"),
    *("left_websockets", "damaged_images", "strange_headers"),
)
"""The attacks that broke an earlier version of the service; the other attacks are preventive."""
