"""Campaigns: detectors on scenes never tuned on, and faults of files, stores, disks and workers."""
