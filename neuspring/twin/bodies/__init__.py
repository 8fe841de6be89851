"""Bodies, one file each: `body` of a module here, or of an installed package, answers what `neuspring.twin.body` asks."""
