"""Reads the configuration of another broker, mosquitto, as one of the appliance's own."""

from appliance.importing.conversion import Imported, NewFile, import_mosquitto
from appliance.importing.notes import ImportProblemsError, Note

__all__ = ["ImportProblemsError", "Imported", "NewFile", "Note", "import_mosquitto"]
