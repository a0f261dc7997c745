"""SIGKILL while a study runs: of the process that runs it, and of its workers."""
