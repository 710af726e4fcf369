"""MQTT 3.1.1 and 5.0 as pure functions and values: bytes in, packets out.

No I/O, no clock and no event loop here. A protocol version is the level in CONNECT: 4 is MQTT 3.1.1
and 5 is MQTT 5.0; 3 is MQTT 3.1, whose connections are taken as those of 3.1.1. Section numbers are
those of both standards, unless a version stands with them.

Comments carry the standard's own tags. `[MQTT-x.y.z-n]` alone is MQTT 3.1.1, or both versions;
`v5 [MQTT-x.y.z-n]` is MQTT 5.0, where it numbers the same statement differently or adds it.
"""
