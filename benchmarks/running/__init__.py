"""Cases on record: methods called in processes that can be killed, ledgers that resume, what is kept of an answer."""
