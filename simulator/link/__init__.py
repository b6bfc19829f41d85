"""The shared-memory link between a server process, which runs the simulator, and a client, which
drives the car. A client can be written in any language.

    simulator link --track forza --name /driverview      starts the server
    simulator.link.client.Link                           a client in Python
    simulator/link/c/lap.c, driverview_link.h            a client in C

`layout` defines the memory layout; the C header is generated from it.
"""
