"""The rules of the service, whoever asks: captures, sessions, jobs, calibrations, rigs, keys, webhooks, retention."""
