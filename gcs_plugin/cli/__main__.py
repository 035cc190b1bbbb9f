"""`python -m gcs_plugin.cli`: the same as `orthoswarm`."""

from gcs_plugin.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
