//! The `rpfd` command.
fn main() {}
