"""The shared-memory link: a server process runs the simulator, a client in any language drives the
car.

    simulator link --track forza --name /driverview      starts the server
    simulator.link.client.Link                           a client in Python
    simulator/link/c/lap.c, driverview_link.h            a client in C

`layout` defines the memory layout; the C header is generated from it.
"""
