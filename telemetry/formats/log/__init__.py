"""Flight logs: tlog, DataFlash, ULog, CAN; and MAVLink messages as poses."""
