"""Bodies, one file each: `BODY` of a module here, or of an installed package, answers what `neuspring.twin.body` asks."""
