"""On PYTHONPATH of an appliance: its links dial again at once, so that minutes have many dials."""

from appliance.upstream import backoff

backoff.SHORTEST, backoff.LONGEST, backoff.CONTESTED = 0.05, 0.2, 1.0
