"""The batch run: from frames to orthoimages, placements and report, stage by stage, each stage resumable."""
