"""The seed's study: its contenders, tables, figures and recordings (`python -m benchmarks paper`)."""
