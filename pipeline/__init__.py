"""From a capture to a head: values in, values out; no stage reads or writes files, the clock or a global."""
