"""Rerun recordings of what is on record: views of a ledger, never the record."""
