"""Spring-Gaus: anchors with directed springs, trained through splats."""
