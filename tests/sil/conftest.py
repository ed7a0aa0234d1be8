from tests.c_cache import compiled_once

fixtures = (compiled_once,)
