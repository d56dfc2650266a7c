//! What a node is towards Zenoh: it puts, takes, answers and catches up, each on a thread of its own.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Result, anyhow};
use flockmap::codec::Encoder;
use flockmap_node::{ConfiguredNode, Log};
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Subscriber;
use zenoh::query::{Query, Queryable};
use zenoh::sample::{Locality, SampleKind};
use zenoh::{Session, Wait};

use crate::answers::{Answers, Kept, Untold, WAITING_MAX};
use crate::catch_up::CatchUp;
use crate::counters::Counters;
use crate::holders::Holders;
use crate::keys::{Keys, parse_holder};
use crate::puts::{Noted, Put, put_all};
use crate::question::Question;
use crate::takes::{By, Intake};

/// What a node does beyond its radio.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Roles {
    /// It puts what it merges and makes.
    pub(crate) puts: bool,
    /// It takes what others put, and asks for what it lacks.
    pub(crate) takes: bool,
    /// It answers, to holders that ask for what they lack.
    pub(crate) answers: bool,
    /// It answers to everybody, under the keys of packages.
    pub(crate) answers_everybody: bool,
    /// It has a radio, and measures the clocks of robots.
    pub(crate) on_radio: bool,
}

/// Who a node is towards Zenoh.
#[derive(Clone)]
pub(crate) struct Identity {
    pub(crate) session: Session,
    pub(crate) keys: Keys,
    /// Of the holder.
    pub(crate) name: String,
    pub(crate) roles: Roles,
    /// How often it looks what others hold.
    pub(crate) period: Duration,
}

/// What was made before the node, for it to be observed.
pub(crate) struct Watched {
    pub(crate) puts: Receiver<Put>,
    pub(crate) noted: Noted,
    pub(crate) counters: Counters,
}

/// The threads of a node, and what they have declared.
#[derive(Default)]
pub(crate) struct Face {
    threads: Vec<JoinHandle<()>>,
    tokens: Option<Subscriber<()>>,
    subscriber: Option<Subscriber<()>>,
    queryables: Vec<Queryable<()>>,
    token: Option<LivelinessToken>,
    /// Wakes the one that catches up, and keeps it there.
    wake: Option<SyncSender<()>>,
}

/// What all of them work with.
struct Parts<'a> {
    identity: &'a Identity,
    node: &'a Arc<ConfiguredNode>,
    counters: &'a Counters,
    log: &'a Log,
}

impl Face {
    /// Starts them.
    pub(crate) fn start(
        identity: &Identity,
        node: &Arc<ConfiguredNode>,
        watched: Watched,
        log: &Log,
    ) -> Result<Self> {
        let Watched { puts, noted, counters } = watched;
        let roles = identity.roles;
        let parts = Parts { identity, node, counters: &counters, log };
        let mut face = Self::default();
        if roles.puts {
            face.start_putting(&parts, puts)?;
        }
        if roles.takes {
            let intake = face.start_giving(&parts, noted)?;
            let holders = Holders::default();
            let woken = face.look_for_holders(&parts, holders.clone())?;
            face.subscribe(&parts, Arc::clone(&intake))?;
            face.start_catching_up(&parts, intake, holders, woken)?;
        }
        if roles.answers {
            let questions = face.start_answering(&parts)?;
            face.take_questions(&parts, &questions)?;
            // Found once it can answer.
            face.be_found(&parts)?;
        }
        Ok(face)
    }

    fn start_putting(&mut self, parts: &Parts<'_>, puts: Receiver<Put>) -> Result<()> {
        let Identity { session, keys, .. } = parts.identity.clone();
        let counters = parts.counters.clone();
        self.thread("put", move || put_all(&session, keys, &puts, &counters))
    }

    /// Gives the robot what comes into the intake.
    fn start_giving(&mut self, parts: &Parts<'_>, noted: Noted) -> Result<Arc<Intake>> {
        let (intake, outlet) = Intake::new(parts.identity.keys, noted, parts.counters.clone());
        let node = Arc::clone(parts.node);
        self.thread("take", move || outlet.give_all(&node.node))?;
        Ok(Arc::new(intake))
    }

    /// Notes the holders that come and go. What it returns is told when one does.
    fn look_for_holders(&mut self, parts: &Parts<'_>, holders: Holders) -> Result<Receiver<()>> {
        let Identity { session, keys, .. } = parts.identity;
        let (wake, woken) = sync_channel(1);
        self.wake = Some(wake.clone());
        let tokens = session.liveliness().declare_subscriber(keys.holder("*")).history(true);
        let tokens = tokens.callback(move |token| {
            let Some((_, _, name)) = parse_holder(token.key_expr().as_str()) else { return };
            if holders.set(name, token.kind() == SampleKind::Put) {
                // If it is being woken already, that will do.
                let _ = wake.try_send(());
            }
        });
        self.tokens = Some(tokens.wait().map_err(|error| anyhow!("cannot look for holders: {error}"))?);
        Ok(woken)
    }

    fn subscribe(&mut self, parts: &Parts<'_>, intake: Arc<Intake>) -> Result<()> {
        let Identity { session, keys, .. } = parts.identity;
        // What this session puts itself is not for it.
        let subscriber = session.declare_subscriber(keys.all()).allowed_origin(Locality::Remote);
        let subscriber = subscriber.callback(move |sample| intake.take(&sample, By::Put)).wait();
        self.subscriber = Some(subscriber.map_err(|error| anyhow!("cannot subscribe: {error}"))?);
        Ok(())
    }

    fn start_catching_up(
        &mut self,
        parts: &Parts<'_>,
        intake: Arc<Intake>,
        holders: Holders,
        woken: Receiver<()>,
    ) -> Result<()> {
        let Identity { session, keys, name, roles, period } = parts.identity.clone();
        let (node, counters, log) = (Arc::clone(parts.node), parts.counters.clone(), parts.log.clone());
        self.thread("catch-up", move || {
            let catch_up = CatchUp {
                session: &session,
                keys,
                name: &name,
                on_radio: roles.on_radio,
                period,
                node: &node.node,
                intake: &intake,
                holders,
                counters: &counters,
                log: &log,
            };
            catch_up.run(&woken);
        })
    }

    /// Answers the questions that it returns the way to.
    fn start_answering(&mut self, parts: &Parts<'_>) -> Result<SyncSender<Query>> {
        let (questions, questions_in) = sync_channel(WAITING_MAX);
        let Identity { keys, name, roles, .. } = parts.identity.clone();
        let (node, counters, log) = (Arc::clone(parts.node), parts.counters.clone(), parts.log.clone());
        self.thread("answers", move || {
            let answers = Answers {
                keys,
                name: &name,
                on_radio: roles.on_radio,
                node: &node.node,
                counters: &counters,
                encoder: Encoder::new(),
                kept: Kept::default(),
                untold: Untold::default(),
                log: &log,
            };
            answers.answer_all(&questions_in);
        })?;
        Ok(questions)
    }

    fn take_questions(&mut self, parts: &Parts<'_>, questions: &SyncSender<Query>) -> Result<()> {
        let Identity { session, keys, name, roles, .. } = parts.identity;
        let mut places = vec![format!("{}/**", keys.holder(name))];
        if roles.answers_everybody {
            places.push(keys.all());
        }
        for place in places {
            let (questions, counters) = (questions.clone(), parts.counters.clone());
            let queryable = session.declare_queryable(place).complete(true).callback(move |query| {
                let Err(TrySendError::Full(query) | TrySendError::Disconnected(query)) =
                    questions.try_send(query)
                else {
                    return;
                };
                counters.queries_refused.add(1);
                query.refuse("too many ask at once: ask again");
            });
            self.queryables.push(queryable.wait().map_err(|error| anyhow!("cannot answer: {error}"))?);
        }
        Ok(())
    }

    fn be_found(&mut self, parts: &Parts<'_>) -> Result<()> {
        let Identity { session, keys, name, .. } = parts.identity;
        let token = session.liveliness().declare_token(keys.holder(name)).wait();
        self.token = Some(token.map_err(|error| anyhow!("cannot be found by others: {error}"))?);
        Ok(())
    }

    fn thread(&mut self, name: &str, work: impl FnOnce() + Send + 'static) -> Result<()> {
        let thread = std::thread::Builder::new().name(name.into()).spawn(work);
        self.threads.push(thread.map_err(|error| anyhow!("cannot start a thread: {error}"))?);
        Ok(())
    }

    /// After the node has ended: puts what is left, and lets go of everything.
    pub(crate) fn end(self) {
        let Self { threads, tokens, subscriber, queryables, token, wake } = self;
        // Others stop asking before nobody answers any more.
        drop((token, tokens, wake, subscriber, queryables));
        for thread in threads {
            // What it was for is over.
            let _ = thread.join();
        }
    }
}
