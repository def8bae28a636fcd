"""From a source to filter updates: samples that can be trusted, integrated over epochs."""
