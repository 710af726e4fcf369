"""`appliance check`: reads everything that `run` would use, reports findings, changes nothing."""

from appliance.ops.check.settings import check
from appliance.ops.finding import Finding

__all__ = ["Finding", "check"]
