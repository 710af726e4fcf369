"""`appliance check`: reads everything that `run` would use, says what it finds, changes nothing."""

from appliance.check.finding import Finding
from appliance.check.settings import check

__all__ = ["Finding", "check"]
