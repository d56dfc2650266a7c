"""A router of Zenoh, as the Python wheel has it: usage: router.py CONFIG.json5. Ends with SIGTERM."""

import signal
import sys
import threading

import zenoh

zenoh.init_log_from_env_or("error")
end = threading.Event()
for name in (signal.SIGTERM, signal.SIGINT):
    signal.signal(name, lambda *_: end.set())
with zenoh.open(zenoh.Config.from_file(sys.argv[1])) as session:
    print("router", session.zid(), flush=True)
    end.wait()
