"""`python -m neuspring` is the `neuspring` command."""

from neuspring.cli.main import main

raise SystemExit(main())
