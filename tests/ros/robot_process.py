"""The demo robot in a process of its own."""

from __future__ import annotations

import json
import queue
import subprocess
import sys
import threading
from pathlib import Path

from waiting import PATIENCE

from appliance.host.environment import for_other_programs


class Robot:
    """robot.py, or another program beside it, in a process of its own."""

    def __init__(self, program="robot.py"):
        self.told = queue.Queue()
        self._answers = queue.Queue()
        self._process = subprocess.Popen(
            [sys.executable, str(Path(__file__).parent / program)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=for_other_programs(),
        )
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for line in self._process.stdout:
            kind, *rest = json.loads(line)
            (self._answers if kind == "ok" else self.told).put([kind, *rest])

    def wait(self):
        return self._answers.get(timeout=PATIENCE)[1]

    def hear(self, *expected):
        """Wait until it has told that by itself."""
        while self.told.get(timeout=PATIENCE)[: len(expected)] != [*expected]:
            pass

    def do(self, *command):
        self._process.stdin.write(json.dumps(command) + "\n")
        self._process.stdin.flush()
        return self.wait()

    def stop(self):
        self._process.stdin.close()
        try:
            self._process.wait(PATIENCE)
        finally:
            self._process.kill()
            self._process.wait()
            self._process.stdout.close()
