"""Bodies, one per file: the attribute `body` of a module here, or of an installed package, is a `neuspring.twin.body.Body`."""
