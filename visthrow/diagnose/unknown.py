"""Laws outside the catalogue."""


def find_laws(search):
    return ()


def beats_the_catalogue(search, terms):
    return ""
