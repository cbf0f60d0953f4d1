"""The commands of `semrecon`, one file each; `semrecon.cli` gathers them."""
