"""What the one file runs first."""

import os, sys

os.environ["_ROS_WHEELS_BOOTSTRAP_COMPLETE"] = "1"
os.environ["AMENT_PREFIX_PATH"] = sys._MEIPASS
if sys.argv[1:2] == ["-m"]:
    import runpy

    module = sys.argv[2]
    sys.argv[1:3] = []
    runpy.run_module(module, run_name="__main__", alter_sys=True)
else:
    from appliance.cli import main

    main()
