"""Gates that a config describes in another way: by a random track, or by one size for all."""

from quadjax.config.schema import Rules
from quadjax.core.errors import InputError, prefixed
from quadjax.core.sections import build, one_line_errors, refuse
from quadjax.core.yaml_files import Sources, Tree, merge_trees
from quadjax.race.random_track import RandomTrack, generate
from quadjax.race.track import TrackSection


def generated(tree: Tree, sources: Sources) -> Tree:
    """A tree with the gates and the rules of the random track that it asks for, if it does.

    Rules of the tree have precedence.

    Raises:
        InputError: settings that are not allowed, or for which no track was found.
    """
    track = tree.get("track")
    if not isinstance(track, dict) or track.get("generate") is None:
        return tree
    path = sources.of("track.generate")
    for key in ("gates", "start", "closed"):
        if key in track:
            raise InputError(f"{path}: track.{key} has no effect with track.generate")
    settings = build(RandomTrack, track["generate"], sources, "track.generate.")
    with prefixed(path):
        values = generate(settings)
    name = track.get("name") or f"random_{settings.gates}_{settings.seed}"
    track = {**track, "generate": None, "name": name, "gates": values["gates"]}
    rules = merge_trees(values["rules"], tree.get("rules") or {})
    return {**tree, "track": track, "rules": rules}


def with_opening(tree: Tree, sources: Sources) -> Tree:
    """A tree whose gates have the size ``track.opening``, if there is one.

    Frames around gates of one size keep their outer edges.

    Raises:
        InputError: a value that is not allowed, an opening wider than the outer edge of the
            frames, or frames around gates of several sizes.
    """
    section = tree.get("track")
    if not isinstance(section, dict) or section.get("opening") is None:
        return tree
    track = build(TrackSection, section, sources, "track.")
    rules = build(Rules, tree.get("rules") or {}, sources, "rules.")
    opening, frame = track.opening or 0.0, rules.gate_frame
    gates = [{**gate, "size": [opening, opening]} for gate in section["gates"]]
    tree = {**tree, "track": {**section, "gates": gates, "opening": None}}
    if frame == 0.0:
        return tree
    sizes = {side for gate in track.gates for side in gate.size}
    wider = frame + 0.5 * (min(sizes) - opening)
    if len(sizes) > 1 or wider < 0.0:
        allowed = f"at most {min(sizes) + 2.0 * frame:g}, the outer edge of the frames"
        if len(sizes) > 1:
            allowed = f"null with rules.gate_frame {frame:g} around gates of sizes {sorted(sizes)}"
        with one_line_errors(sources):
            refuse("track.opening", opening, allowed)
    return {**tree, "rules": {**(tree.get("rules") or {}), "gate_frame": wider}}
