"""Heavy work, and the child processes that it runs in: functions of files, which know no service."""
