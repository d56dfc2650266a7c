//! The house: no circle of imports between the files of a crate, and no arrow up between crates.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use syn::visit::{self, Visit};

/// A module by its path within its crate; the crate itself is empty.
type Module = Vec<String>;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// The crates of the workspace, in its order.
fn crates() -> Vec<String> {
    let manifest: toml::Table = std::fs::read_to_string(root().join("Cargo.toml")).unwrap().parse().unwrap();
    let members = manifest["workspace"]["members"].as_array().unwrap();
    members.iter().map(|member| member.as_str().unwrap().trim_start_matches("crates/").to_owned()).collect()
}

/// What a file says of others: names that it forwards, and paths that it uses.
#[derive(Default)]
struct Seen {
    module: Module,
    forwarded: BTreeMap<String, Module>,
    used: Vec<Module>,
    /// Names of the modules that are declared in it.
    children: BTreeSet<String>,
}

impl Seen {
    /// A path as the crate knows it; `None` if it leads out of the crate.
    fn absolute(&self, path: &[String]) -> Option<Module> {
        let up = path.iter().take_while(|part| *part == "super").count();
        match path.first()?.as_str() {
            "crate" => Some(path[1..].to_vec()),
            "self" => Some([&self.module, &path[1..]].concat()),
            "super" => Some([&self.module[..self.module.len().checked_sub(up)?], &path[up..]].concat()),
            first if self.children.contains(first) => Some([&self.module, path].concat()),
            _ => None,
        }
    }

    fn take_tree(&mut self, tree: &syn::UseTree, before: &[String], is_forwarded: bool) {
        let with = |name: &syn::Ident| [before, &[name.to_string()]].concat();
        let (path, name) = match tree {
            syn::UseTree::Path(path) => return self.take_tree(&path.tree, &with(&path.ident), is_forwarded),
            syn::UseTree::Group(group) => {
                return group.items.iter().for_each(|tree| self.take_tree(tree, before, is_forwarded));
            }
            syn::UseTree::Name(name) if name.ident == "self" => {
                (before.to_vec(), before.last().cloned().unwrap_or_default())
            }
            syn::UseTree::Name(name) => (with(&name.ident), name.ident.to_string()),
            syn::UseTree::Rename(rename) => (with(&rename.ident), rename.rename.to_string()),
            syn::UseTree::Glob(_) => (before.to_vec(), "*".to_owned()),
        };
        let Some(path) = self.absolute(&path) else { return };
        if is_forwarded {
            self.forwarded.insert(name, path);
        } else {
            self.used.push(path);
        }
    }
}

fn is_test(attributes: &[syn::Attribute]) -> bool {
    attributes.iter().any(|a| {
        a.path().is_ident("cfg") && a.meta.require_list().is_ok_and(|list| list.tokens.to_string() == "test")
    })
}

impl<'ast> Visit<'ast> for Seen {
    fn visit_item(&mut self, item: &'ast syn::Item) {
        match item {
            syn::Item::Mod(module) if is_test(&module.attrs) => {}
            syn::Item::Use(item) if is_test(&item.attrs) => {}
            syn::Item::Use(item) => {
                self.take_tree(&item.tree, &[], !matches!(item.vis, syn::Visibility::Inherited));
            }
            _ => visit::visit_item(self, item),
        }
    }

    fn visit_path(&mut self, path: &'ast syn::Path) {
        let parts: Vec<String> = path.segments.iter().map(|segment| segment.ident.to_string()).collect();
        if parts.len() > 1 {
            self.used.extend(self.absolute(&parts));
        }
        visit::visit_path(self, path);
    }
}

/// The files of a crate by module.
fn read(crate_name: &str) -> BTreeMap<Module, Seen> {
    let src = root().join("crates").join(crate_name).join("src");
    let mut files = BTreeMap::new();
    let mut folders = vec![(src, Module::new())];
    while let Some((folder, module)) = folders.pop() {
        for entry in std::fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            let stem = path.file_stem().unwrap().to_str().unwrap().to_owned();
            if path.is_dir() {
                folders.push((path, [&module[..], &[stem]].concat()));
            } else if path.extension().is_some_and(|e| e == "rs") && stem != "tests" {
                let module = match stem.as_str() {
                    "lib" | "main" | "mod" => module.clone(),
                    _ => [&module[..], &[stem]].concat(),
                };
                let file = syn::parse_file(&std::fs::read_to_string(&path).unwrap()).unwrap();
                let children = file.items.iter().filter_map(|item| match item {
                    syn::Item::Mod(module) if module.content.is_none() => Some(module.ident.to_string()),
                    _ => None,
                });
                let children = children.collect();
                let mut seen = Seen { module: module.clone(), children, ..Seen::default() };
                seen.visit_file(&file);
                // A library and a program in one crate are one face.
                let known: &mut Seen = files.entry(module).or_default();
                known.forwarded.extend(seen.forwarded);
                known.used.extend(seen.used);
            }
        }
    }
    files
}

/// The file in which what a path names is made.
fn maker(files: &BTreeMap<Module, Seen>, path: &[String], hops: usize) -> Module {
    let longest = (0..=path.len()).rev().find(|n| files.contains_key(&path[..*n])).unwrap_or(0);
    let (module, rest) = path.split_at(longest);
    let forwarded = &files[module].forwarded;
    let next = rest.first().and_then(|name| match (forwarded.get(name), forwarded.get("*")) {
        (Some(path), _) => Some([&path[..], &rest[1..]].concat()),
        (None, Some(path)) => Some([&path[..], rest].concat()),
        (None, None) => None,
    });
    match next {
        Some(next) if hops < 8 => maker(files, &next, hops + 1),
        _ => module.to_vec(),
    }
}

/// A circle of imports, if there is one.
fn circle(imports: &BTreeMap<Module, BTreeSet<Module>>) -> Option<Vec<Module>> {
    fn walk(
        imports: &BTreeMap<Module, BTreeSet<Module>>,
        at: &Module,
        track: &mut Vec<Module>,
        done: &mut BTreeSet<Module>,
    ) -> Option<Vec<Module>> {
        if let Some(begin) = track.iter().position(|module| module == at) {
            return Some(track[begin..].to_vec());
        }
        if !done.insert(at.clone()) {
            return None;
        }
        track.push(at.clone());
        let found = imports[at].iter().find_map(|next| walk(imports, next, track, done));
        track.pop();
        found
    }
    let mut done = BTreeSet::new();
    imports.keys().find_map(|module| walk(imports, module, &mut Vec::new(), &mut done))
}

fn imports_of(files: &BTreeMap<Module, Seen>) -> BTreeMap<Module, BTreeSet<Module>> {
    let imports = files.iter().map(|(module, seen)| {
        let makers = seen.used.iter().map(|path| maker(files, path, 0));
        (module.clone(), makers.filter(|maker| maker != module).collect())
    });
    imports.collect()
}

#[test]
fn no_files_of_a_crate_import_each_other_in_a_circle() {
    let mut arrows = 0;
    for name in crates() {
        let imports = imports_of(&read(&name));
        arrows += imports.values().map(BTreeSet::len).sum::<usize>();
        if let Some(circle) = circle(&imports) {
            let files: Vec<String> = circle.iter().map(|module| module.join("/")).collect();
            panic!("a circle in {name}: {}", files.join(" -> "));
        }
    }
    println!("{arrows} arrows");
    assert!(arrows > 500, "{arrows} arrows between files: most were not seen");
}

#[test]
fn a_crate_imports_only_crates_that_stand_above_it() {
    let names = crates();
    for (at, name) in names.iter().enumerate() {
        let path = root().join("crates").join(name).join("Cargo.toml");
        let manifest: toml::Table = std::fs::read_to_string(path).unwrap().parse().unwrap();
        let Some(dependencies) = manifest.get("dependencies").and_then(toml::Value::as_table) else {
            continue;
        };
        for dependency in dependencies.keys().filter(|name| name.starts_with("flockmap")) {
            let above = names.iter().position(|other| other == dependency);
            assert!(
                above.is_some_and(|above| above < at),
                "{name} imports {dependency}, which stands below it"
            );
        }
    }
}

#[test]
fn a_circle_is_seen() {
    let names = |text: &[&str]| text.iter().map(|name| vec![(*name).to_owned()]).collect::<BTreeSet<_>>();
    let imports = [("a", names(&["b"])), ("b", names(&["c"])), ("c", names(&["a"])), ("d", names(&["a"]))];
    let imports = imports.into_iter().map(|(name, to)| (vec![name.to_owned()], to)).collect();
    assert_eq!(circle(&imports).unwrap().len(), 3);
}
