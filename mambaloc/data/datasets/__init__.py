"""One file per dataset: how its splits are read; and the registry of datasets."""
