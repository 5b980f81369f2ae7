"""The words that ``task`` knows, sorted by what they do in a sentence."""


def _table(**rows: str) -> dict[str, str]:
    """Turns ``name="synonym synonym"`` into {synonym: name, name: name}."""
    return {word: name for name, words in rows.items() for word in [name, *words.split()]}


def _set(words: str) -> frozenset[str]:
    return frozenset(words.split())


PART_WORDS = _table(
    handle="grip handgrip haft hilt loop",
    head="face snout peen",
    blade="",
    shaft="rod shank stem",
    tip="point",
    bowl="",
    bristles="bristle",
    body="barrel belly torso back wall",
    rim="lip brim edge",
    cap="lid cork stopper",
    spout="nozzle",
    tail="",
    leg="foot feet paw",
    claw="",
    neck="",
    base="bottom battery",
    chuck="",
    trigger="",
    horn="",
    top="",
    middle="centre center",
)
"""Words for parts and the one name that stands for each group."""

VAGUE_PARTS = _set("top point face edge middle centre center bottom base back wall")
"""Part words that name a part only after "by", "at" or a verb of holding."""


COLOUR_WORDS = _table(
    red="crimson maroon scarlet",
    orange="",
    yellow="golden gold",
    green="lime olive",
    cyan="turquoise teal",
    blue="navy",
    purple="violet",
    pink="magenta",
    brown="tan beige",
    black="",
    white="",
    grey="gray silver",
)
"""Words for colours and the one name that stands for each group."""


# Verbs that ask to use the object as it is meant to be used, by the tool that each implies.
USE_VERBS = {
    verb: tool
    for tool, verbs in {
        "hammer": "hammer nail pound",
        "brush": "brush scrub sweep paint",
        "screwdriver": "screw unscrew tighten loosen",
        "knife": "cut slice chop carve",
        "spoon": "stir scoop",
        "spatula": "flip",
        "mug": "drink sip",
        "drill": "drill",
        "saw": "saw",
        "whisk": "whisk",
        "": "use using drive hit strike knock beat pry pour fill eat serve spread fry cook write "
        "draw dig squeeze spray shake clean wash wipe mix peel operate play bake",
    }.items()
    for verb in verbs.split()
}
# Verbs above that are as often nouns: verbs only where a sentence can have one.
NOUN_OR_VERB = _set("hammer nail brush paint screw drill saw whisk drink cut scoop spray play use")
HANDOVER_VERBS = _set("give pass bring deliver offer handover fetch lend present")
HOLD_VERBS = _set(
    "hold grab grasp grip take pick lift get carry move raise clutch seize pinch touch keep put "
    "place clear remove"
)
MISHAPS = _set("drop spill break damage hurt scratch crush bend")
RECIPIENTS = _set("me us him her them")
PERSON = _set("i we he she they")
DETERMINERS = _set("the a an my your his her its their our this that these those some")
OPENERS = _set("please to and then now you robot just only gently carefully quickly lets kindly")
PREPOSITIONS = _set(
    "by at around near along via on in into onto to from against under over off with of for "
    "towards toward behind beside next between inside through without"
)
NEGATORS = _set(
    "not dont never avoid avoiding without except excluding neither nor cannot cant shouldnt "
    "mustnt doesnt no"
)
NEGATING_PAIRS = {
    ("away", "from"), ("instead", "of"), ("rather", "than"), ("other", "than"), ("anywhere", "but"),
    ("anything", "but"), ("clear", "of"), ("keep", "off"), ("stay", "off"), ("hands", "off"),
}  # fmt: skip
JOINING = _set("or nor and by at")
# "the knife, handle first": the part is for the person, so the robot must leave it free.
OFFERED = _set("first facing towards toward pointing forward free clear accessible")
VERBS = (USE_VERBS.keys() - NOUN_OR_VERB) | {"use", "open"} | HANDOVER_VERBS | HOLD_VERBS
VERBS |= MISHAPS
STOP = (
    VERBS | RECIPIENTS | PERSON | DETERMINERS | OPENERS | PREPOSITIONS | NEGATORS | OFFERED
) | _set(
    "it one ones is are was be been being can could will would should shall may might must do does "
    "did have has had need want like so which who where when while if but or rather instead than "
    "other anywhere anything all up down out away back here there very way time thing object item "
    "care end side part direction hand as ready let make made sure try used both any each s t"
)
