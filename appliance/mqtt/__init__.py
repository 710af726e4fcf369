"""MQTT 3.1.1 and 5.0 as pure functions and values: bytes in, packets out.

There is no I/O, no clock and no event loop here. A protocol version is the level in CONNECT: 4 is
MQTT 3.1.1 and 5 is MQTT 5.0; 3 is MQTT 3.1, whose connections are treated as those of 3.1.1.
Section numbers are those of both standards, unless a version is given.

Comments quote the standard's tags. `[MQTT-x.y.z-n]` alone is MQTT 3.1.1, or both versions;
`v5 [MQTT-x.y.z-n]` is MQTT 5.0, where it numbers the same statement differently or adds it.
"""
