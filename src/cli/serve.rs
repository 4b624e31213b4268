//! `rpfd serve`.

use std::path::PathBuf;

use clap::{Arg, ArgMatches};
use tokio::signal::unix::{Signal, SignalKind, signal};

use super::{Failure, FailureKind, allocator};
use crate::{
    config::{
        Config, LogFormat, SETTINGS,
        load::{Loaded, flag, load},
    },
    service::{Reload, ServeError, Service},
};

/// The file, and the flags, which have the names of the settings.
#[derive(Default)]
pub(crate) struct Args {
    file: Option<PathBuf>,
    print: bool,
    flags: Vec<(String, String)>,
}

const ABOUT: &str = "Run the service

It answers at POST /v1/filter (tiles in, results out) and below /v1/images (images stitched from tiles). The address it \
listens on is printed to standard output, the log goes to standard error. SIGTERM and Ctrl-C stop it: what has begun is \
finished first. SIGHUP: the tokens are read again.

Every setting is a flag, an environment variable (--queue-deadline is RPFD_QUEUE_DEADLINE) and a key of the file \
(queue_deadline); the flag wins over the variable, and the variable over the file. Sizes are like 512MiB, times like \
200ms, 30s or 5m.";

const EXAMPLES: &str = "Examples:
  rpfd serve
  rpfd serve --listen 127.0.0.1:0 --memory 4GiB --data-dir /var/lib/rpfd
  rpfd serve --config rpfd.toml --print-config
  curl -T tile.tiles -H 'Accept: image/png' -o tile.png http://127.0.0.1:8080/v1/filter";

impl clap::Args for Args {
    fn augment_args(command: clap::Command) -> clap::Command {
        let default = Config::default();
        let config = Arg::new("config").long("config").value_name("FILE");
        let print = Arg::new("print_config").long("print-config").action(clap::ArgAction::SetTrue);
        let settings = SETTINGS.iter().map(|setting| {
            let help = setting.help.iter().map(|line| line.trim()).collect::<Vec<_>>().join(" ");
            let default = (setting.to_toml)(&default)
                .map_or_else(String::new, |value| format!(" [default: {}]", value.trim_matches('"')));
            let arg = Arg::new(setting.name).long(flag(setting.name).split_off(2)).help(format!("{help}{default}"));
            match setting.value {
                "" => arg.num_args(0..=1).require_equals(true).default_missing_value("true").value_name("true|false"),
                value => arg.value_name(value),
            }
        });
        let command = command.about("Run the service").long_about(ABOUT).after_long_help(EXAMPLES);
        command
            .arg(
                config
                    .value_parser(clap::value_parser!(PathBuf))
                    .help("TOML file of settings, like --print-config prints; RPFD_CONFIG names it too"),
            )
            .arg(print.help("Print the settings that are in force, with defaults and where they are from, and end"))
            .args(settings)
    }

    fn augment_args_for_update(command: clap::Command) -> clap::Command {
        Self::augment_args(command)
    }
}

impl clap::FromArgMatches for Args {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        let mut args = Self::default();
        args.update_from_arg_matches(matches)?;
        Ok(args)
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        self.file = matches.get_one::<PathBuf>("config").cloned();
        self.print = matches.get_flag("print_config");
        let given = |name: &str| Some((name.to_owned(), matches.get_one::<String>(name)?.clone()));
        self.flags = SETTINGS.iter().filter_map(|setting| given(setting.name)).collect();
        Ok(())
    }
}

impl From<ServeError> for Failure {
    fn from(error: ServeError) -> Self {
        let usage = matches!(error, ServeError::Config(_) | ServeError::Tokens(_));
        Self::new(if usage { FailureKind::Usage } else { FailureKind::Failed }, error.code(), error)
    }
}

impl Args {
    fn load(self) -> Result<Loaded, Failure> {
        // What is not text is no setting of ours; under a name of ours it is a wrong value.
        let environment = std::env::vars_os()
            .filter_map(|(name, value)| Some((name.into_string().ok()?, value.to_string_lossy().into_owned())));
        let file = self.file.or_else(|| std::env::var_os("RPFD_CONFIG").map(PathBuf::from));
        let loaded = load(self.flags, environment, file.as_deref());
        loaded.map_err(|error| Failure::usage("bad_config", error))
    }
}

fn start_log(config: &Config) {
    use std::io::IsTerminal;
    use tracing_subscriber::EnvFilter;
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(&config.log));
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    match config.log_format {
        LogFormat::Text => log.with_ansi(std::io::stderr().is_terminal()).init(),
        LogFormat::Json => log.json().flatten_event(true).with_current_span(true).with_span_list(false).init(),
    }
}

/// Reads the tokens at every SIGHUP.
async fn reload(mut hangup: Signal, reload: Reload) {
    while hangup.recv().await.is_some() {
        let again = reload.clone();
        match tokio::task::spawn_blocking(move || again.tokens()).await {
            Ok(Ok(tokens)) => tracing::info!(tokens, "tokens read again"),
            Ok(Err(error)) => tracing::error!(%error, "tokens not read again; those from before stay valid"),
            Err(error) => tracing::error!(%error, "tokens not read again"),
        }
    }
}

pub(crate) fn run(args: Args) -> Result<(), Failure> {
    use std::io::Write;
    allocator::settle();
    let print = args.print;
    let loaded = args.load()?;
    if print {
        say!("{}", loaded.to_toml().trim_end());
        return Ok(());
    }
    start_log(&loaded.config);
    let threads = loaded.config.threads;
    let service = Service::bind(loaded.config)?;
    let failed = |error: std::io::Error| Failure::new(FailureKind::Failed, "runtime", error);
    // Jobs, and what reads and writes files for them and for those who read results.
    let blocking = threads + 16;
    let mut runtime = tokio::runtime::Builder::new_multi_thread();
    let runtime = runtime.enable_all().max_blocking_threads(blocking).build().map_err(failed)?;
    let result = runtime.block_on(async {
        let mut terminate = signal(SignalKind::terminate()).map_err(failed)?;
        let mut interrupt = signal(SignalKind::interrupt()).map_err(failed)?;
        tokio::spawn(reload(signal(SignalKind::hangup()).map_err(failed)?, service.reload()));
        // Signals are heeded from here on: who reads the address may send one.
        let mut out = std::io::stdout();
        let mut said = writeln!(out, "listening on http://{}", service.local_addr());
        if let Some(address) = service.metrics_addr() {
            said = said.and_then(|()| writeln!(out, "metrics at http://{address}/metrics"));
        }
        said.and_then(|()| out.flush()).map_err(failed)?;
        let stopped = async {
            tokio::select! {
                _ = terminate.recv() => {}
                _ = interrupt.recv() => {}
            }
        };
        Ok(service.run(stopped).await?)
    });
    // Jobs without a client stop soon; none of them is worth waiting for.
    runtime.shutdown_timeout(std::time::Duration::from_secs(2));
    result
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_setting_is_a_flag_and_says_so() {
        let command = <Args as clap::Args>::augment_args(clap::Command::new("serve"));
        for setting in SETTINGS {
            let long = flag(setting.name);
            assert!(command.get_arguments().any(|arg| arg.get_long() == Some(&long[2..])), "{long}");
        }
        let matches = command.get_matches_from(["serve", "--insecure-no-auth", "--queue-deadline", "0.3"]);
        let args = <Args as clap::FromArgMatches>::from_arg_matches(&matches).unwrap();
        let loaded = load(args.flags, [], None).unwrap();
        assert!(loaded.config.insecure_no_auth);
        assert_eq!(loaded.config.queue_deadline, std::time::Duration::from_millis(300));
    }
}
