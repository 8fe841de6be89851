"""The steps of the workflow: one file is one rule, one command and one record."""
