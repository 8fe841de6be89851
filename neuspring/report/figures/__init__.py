"""PNG figures: of a run (`run`, `twin`, `images`), of a benchmark (`ratios`, `clusters`); `views` has their helpers."""
