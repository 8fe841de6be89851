"""`python -m neuspring` is the `neuspring` command."""

from neuspring.cli import main

raise SystemExit(main())
