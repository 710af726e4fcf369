"""Multicast DNS: the appliance is announced on its network, and found there (RFC 6762, 6763).

The announcing is a program of its own (`announcer.py`), which the appliance starts and watches
(`process.py`); `search.py` is `appliance find`.
"""
