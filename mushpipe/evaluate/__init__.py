"""Judging results against the truth: matching, errors with intervals, tables and reports."""
