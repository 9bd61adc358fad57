"""Plans: what to do in one session, and which truths are planned for."""

from visthrow.diagnose.planning import plan


def test_a_session_holds_what_separates_more_than_what_stands_before_it():
    said = (
        ("circle", (("a", "b"), ("a", "c"))),
        ("swing", (("a", "c"),)),
        ("hover", ()),
        ("weigh", (("a", "d"),)),
    )
    proposals = [
        plan.FlightProposal(name, "", 10.0, 12.0, separates, 1, "") for name, separates in said
    ]
    assert [p.name for p in plan.session(proposals)] == ["circle", "weigh"]
