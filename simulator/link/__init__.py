"""The shared-memory link: an engine process drives the car, a client in any language steers it.

    simulator link --track forza --name /driverview      the engine
    simulator.link.client.Link                           a client in Python
    simulator/link/c/lap.c, driverview_link.h            a client in C

`layout` is the one definition of what lies where; the C header is made from it.
"""
