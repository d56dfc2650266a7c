//! Names of topics and their namespaces.

/// The namespace of a topic: all before its last slash.
pub(crate) fn namespace(topic: &str) -> &str {
    topic.rsplit_once('/').map_or("", |(namespace, _)| namespace)
}

/// Whether a namespace is another one, or lies within it.
pub(crate) fn is_within(namespace: &str, outer: &str) -> bool {
    namespace.strip_prefix(outer).is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
}

/// How many names at the start of the namespaces of two topics are the same.
pub(crate) fn shared_names(a: &str, b: &str) -> usize {
    let names = |topic| namespace(topic).split('/').filter(|name| !name.is_empty());
    names(a).zip(names(b)).take_while(|(a, b)| a == b).count()
}
