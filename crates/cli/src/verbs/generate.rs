//! Man pages and shell completions, from the same definitions as `--help`.

use std::path::Path;

use clap::CommandFactory;
use clap_complete::{Shell, generate_to};

use crate::args::{Cli, GenerateArgs, Generated};
use crate::error::{CliError, Done};

pub(crate) fn run(args: &GenerateArgs) -> Done {
    let failed = |e: std::io::Error| CliError::Input(format!("--out {}: {e}", args.out.display()));
    std::fs::create_dir_all(&args.out).map_err(failed)?;
    let mut command = Cli::command();
    let shell = match args.what {
        Generated::Man => return man(&command, &args.out).map_err(failed),
        Generated::Bash => Shell::Bash,
        Generated::Zsh => Shell::Zsh,
        Generated::Fish => Shell::Fish,
    };
    let path = generate_to(shell, &mut command, "use3d", &args.out).map_err(failed)?;
    eprintln!("{}", path.display());
    Ok(())
}

fn man(command: &clap::Command, out: &Path) -> std::io::Result<()> {
    clap_mangen::generate_to(command.clone(), out)
}
