//! The `rpfd` command: parse, run, exit code.

fn main() -> std::process::ExitCode {
    rpfd::cli::main()
}
