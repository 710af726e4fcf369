"""Authentication and authorization: the users file and the ACL file, in mosquitto's formats."""

from __future__ import annotations

from appliance.access.acl import Acl, ActionVerdict, Explanation
from appliance.access.files import Changes, FileAccess, Rules
from appliance.access.login import LoginPlugins, LoginPolicy, no_user
from appliance.access.passwords import Passwords, check_hash, check_password, check_username
from appliance.access.problems import AccessFileError, FileProblem
from appliance.access.rules import Permission, Rule
from appliance.access.token_file import TokenFile
from appliance.access.tokens import LIFETIME as TOKEN_LIFETIME
from appliance.access.tokens import is_token
from appliance.broker.values import Refusal

__all__ = [
    "TOKEN_LIFETIME",
    "AccessFileError",
    "Acl",
    "ActionVerdict",
    "Changes",
    "Explanation",
    "FileAccess",
    "FileProblem",
    "LoginPlugins",
    "LoginPolicy",
    "Passwords",
    "Permission",
    "Refusal",
    "Rule",
    "Rules",
    "TokenFile",
    "check_hash",
    "check_password",
    "check_username",
    "is_token",
    "no_user",
]
