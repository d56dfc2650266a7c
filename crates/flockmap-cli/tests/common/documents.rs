//! The commands that the documents show.

use std::path::Path;

use clap::Parser;
use flockmap_cli::program;

/// Fails on a command in a document that calls this program and is not understood, or if there are not more
/// than so many.
pub(crate) fn assert_understood<C: Parser>(program: &str, more_than: usize) {
    let commands = commands_of(program);
    assert!(commands.len() > more_than, "only {} commands are found", commands.len());
    let mut wrong = Vec::new();
    for (line, words) in commands {
        match program::try_parse::<C>(std::iter::once(String::new()).chain(words)) {
            Err(error) if error.exit_code() != 0 => wrong.push(format!("{line}\n{error}")),
            _ => {}
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// The words of each command line in a document of the project, such as `flockmap replay …` or `cargo run
/// --release -- replay …`, that calls this program. Comments, output redirections and what follows a pipe are
/// left out.
fn commands_of(program: &str) -> Vec<(String, Vec<String>)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let mut documents: Vec<_> = ["README.md", "BENCHMARK.md", "ARCHITECTURE.md", "WIRE.md"]
        .map(|name| root.join(name))
        .into_iter()
        .chain(std::fs::read_dir(root.join("docs")).unwrap().map(|entry| entry.unwrap().path()))
        .filter(|path| path.extension().is_some_and(|ending| ending == "md"))
        .collect();
    documents.sort();
    let mut commands = Vec::new();
    for document in documents {
        let text = std::fs::read_to_string(&document).unwrap();
        for line in text.lines() {
            let of_cargo = ["cargo run --release -- ", "cargo run --release -p flockmap-bench -- "];
            let starts = [("flockmap ", "flockmap"), ("flockmap-bench ", "flockmap-bench")];
            let code = line.split('`').skip(1).step_by(2).chain([line.trim_start()]);
            for code in code {
                let cargo = of_cargo.iter().position(|start| code.starts_with(start));
                let (name, rest) = match cargo {
                    Some(at) => (starts[at].1, &code[of_cargo[at].len()..]),
                    None => match starts.iter().find(|(start, _)| code.starts_with(start)) {
                        Some((start, name)) => (*name, &code[start.len()..]),
                        None => continue,
                    },
                };
                // A command that is only mentioned by its name.
                let is_mention = cargo.is_none() && !rest.contains(['-', '.', '/']);
                if name == program && !is_mention {
                    let end = rest.find(['#', '>', '|', '&']).unwrap_or(rest.len());
                    let at = format!("{}: {line}", document.file_name().unwrap_or_default().display());
                    // As from the root of the project.
                    let from_root = |word: String| match word.starts_with("crates/") {
                        true => root.join(word).display().to_string(),
                        false => word,
                    };
                    commands.push((at, words(&rest[..end]).into_iter().map(from_root).collect()));
                }
            }
        }
    }
    commands
}

/// As a shell splits them, with double quotes.
fn words(text: &str) -> Vec<String> {
    let quoted = text.split('"').enumerate();
    quoted
        .flat_map(|(i, part)| match i % 2 {
            0 => part.split_whitespace().map(str::to_owned).collect(),
            _ => vec![part.to_owned()],
        })
        .collect()
}
