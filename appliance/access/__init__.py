"""Who may come in and what they may do: the users file and the ACL file, in mosquitto's formats."""

from __future__ import annotations

from appliance.broker.ports import Refusal

from .acl import Acl, Explanation, Verdict
from .files import Changes, FileAccess, Rules
from .passwords import Passwords, check_password, check_username
from .problems import AccessFileError, Problem
from .rules import Permission, Rule

__all__ = [
    "AccessFileError",
    "Acl",
    "Changes",
    "Explanation",
    "FileAccess",
    "Passwords",
    "Permission",
    "Problem",
    "Refusal",
    "Rule",
    "Rules",
    "Verdict",
    "check_password",
    "check_username",
]
