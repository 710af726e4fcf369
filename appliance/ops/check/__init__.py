"""`appliance check`: reads everything that `run` would use, says what it finds, changes nothing."""

from appliance.ops.check.finding import Finding
from appliance.ops.check.settings import check

__all__ = ["Finding", "check"]
